'''Dialects: the layers of Caffe's forks, one file for each, with their additions to the schema.

A prototxt with fields or layers that Caffe does not have uses the dialects that define them. Other nets of the process
do not: a layer that replaces one of Caffe's is used only in nets that use the dialect (BuildOptions.dialects). To add a
dialect from a file, for every net of the process, pass ``--plugin FILE.py`` on the command line, or call
``netspec.use_dialect("FILE.py")``. If several dialects define a field, the fields inside it decide which one is meant;
if they do not, and for a layer type of several dialects, write ``# dialect: NAME`` into the prototxt or pass
``--plugin NAME``. If forks define different layers of one type, the table in netspec/dialects/signatures.py decides.

To write a dialect, save this as a file, for example ``doubling.py``, and pass ``--plugin doubling.py``::

    """A fork with a layer that multiplies."""

    from netspec.layers import Layer, register
    from netspec.proto.schema import value

    DECLARATIONS = """
    message TimesParameter {
      optional float factor = 1 [default = 2];
    }
    extend LayerParameter {
      optional TimesParameter times_param = 1000;
    }
    """

    @register("Times", "times_param")
    class Times(Layer):
        """Multiply by a number.

        bottom[0]  any shape
        top[0]     the same shape
        """

        def reshape(self, bottom_shapes):
            return bottom_shapes

        def forward(self, data):
            return data * value(self.param, "times_param").factor

``DECLARATIONS`` is a string in the syntax of caffe.proto (netspec/dialects/registry.py): the messages of the fork,
and new fields of Caffe's messages in ``extend``. A layer is written like Caffe's own
(netspec/layers/contract/base.py). ``@register`` gets its type and the fields of LayerParameter that it reads: a net
warns of fields that no layer reads. ``@replace("Dropout", ...)`` of netspec/dialects/layers.py replaces one of Caffe's
layers by a subclass, in nets that use the dialect, to support a field that the fork added to it.
'''

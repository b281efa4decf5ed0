'''Dialects: the layers of Caffe's forks, one file for each, with their additions to the schema.

A prototxt with fields or layers that Caffe does not have activates the dialects that define them: netspec's own (the
files in this folder), and those of installed packages (entry points of the group ``netspec.dialects``). To add a
dialect from a file, for every net of the process, pass ``--plugin FILE.py`` on the command line, or call
``netspec.use_dialect("FILE.py")``. The whole process then knows the new fields, because protobuf has one schema for a
process. A layer that replaces one of Caffe's is used only in nets that use the dialect (BuildOptions.dialects). A field
or layer type that several dialects define is an error; ``--plugin NAME`` chooses one. If forks define different layers
of one type, the table in netspec/dialects/signatures.py decides which one is meant.

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
layers by a subclass, in nets that use the dialect, to support a field that the fork added to it. To provide a dialect
in a package, name its module in the package's pyproject.toml::

    [project.entry-points."netspec.dialects"]
    doubling = "mypackage.doubling"
'''

from __future__ import annotations

from pathlib import Path

from netspec.dialects.files import activate_file, find_file


def use_dialect(name: str | Path) -> None:
    """Add the fields and layers of a dialect to the whole process. ``name`` is its name, or the path of its file.

    Does nothing if it was added before. Raises SpecError if there is no such dialect, if its file has an error, or if
    Caffe or another dialect already has one of its fields or layer types.
    """
    from netspec.dialects.layers import use_everywhere  # imported here, since it needs torch

    file = find_file(name)
    activate_file(file)
    use_everywhere(file.name)

'''Dialects: the layers of Caffe's forks, one file each, with what they add to the schema.

A prototxt that uses what Caffe does not have switches on the dialects that have it: netspec's own (the files in this
folder), and those that installed packages offer (entry points of the group ``netspec.dialects``). ``--plugin FILE.py``
on the command line, or ``netspec.use_dialect("FILE.py")``, adds one from a file, for every net of the process. The
fields that dialects add are known to the whole process from then on, since protobuf has one schema in it; layers in the
place of Caffe's are those of the nets that use the dialect (BuildOptions.dialects). A field or a layer type that
several dialects have is an error, and ``--plugin NAME`` says which is meant. Whose a layer is, where forks have
different layers of one type, is decided in one table: netspec/dialects/signatures.py.

To write one, put this into a file, say ``doubling.py``, and pass ``--plugin doubling.py``::

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

``DECLARATIONS`` is in the language of caffe.proto (netspec/dialects/registry.py): messages as they stand in the
fork, new fields of Caffe's messages in ``extend``; one plain string. A layer is as Caffe's own are
(netspec/layers/contract/base.py);
``@register`` has its type and the fields of LayerParameter that it reads: a net warns of fields that no layer reads.
``@replace("Dropout", ...)`` of netspec/dialects/layers.py puts a subclass in the place of one of Caffe's layers, to
honor a field that the fork added to it, in nets that use the dialect. To offer a dialect with a package, name its
module in that package's pyproject.toml::

    [project.entry-points."netspec.dialects"]
    doubling = "mypackage.doubling"
'''

from __future__ import annotations

from pathlib import Path

from netspec.dialects.files import find_file, switch_on


def use_dialect(name: str | Path) -> None:
    """Add the fields and layers of a dialect, given by its name or the path of its file, for the whole process.

    Does nothing where it is there already. Raises SpecError where there is no such dialect, its file has a fault, or
    Caffe or another dialect has one of its fields or layer types.
    """
    from netspec.dialects.layers import use_everywhere  # it needs torch

    file = find_file(name)
    switch_on(file)
    use_everywhere(file.name)

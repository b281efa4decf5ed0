'''Dialects: the layers of Caffe's forks, one file for each, with their additions to the schema.

A prototxt with fields or layers that Caffe does not have uses the dialects that define them: netspec's own (the files
in this folder), and those of installed packages (entry points of the group ``netspec.dialects``). Other nets of the
process do not: a layer that replaces one of Caffe's is used only in nets that use the dialect (BuildOptions.dialects).
To add a dialect from a file, for every net of the process, pass ``--plugin FILE.py`` on the command line, or call
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
layers by a subclass, in nets that use the dialect, to support a field that the fork added to it. To provide a dialect
in a package, name its module in the package's pyproject.toml::

    [project.entry-points."netspec.dialects"]
    doubling = "mypackage.doubling"
'''

from __future__ import annotations

from pathlib import Path

from netspec.dialects import known
from netspec.dialects.files import find_file, read_dialect


def use_dialect(name: str | Path) -> None:
    """Add the fields and layers of a dialect to every net of the process. ``name`` is its name, or that of its file.

    Does nothing if it was added before. Raises SpecError if there is no such dialect, if its file has an error, or if
    Caffe already has one of its fields or layer types.
    """
    from netspec.dialects.layers import load  # imported here, since it needs torch

    dialect = read_dialect(find_file(name))
    if dialect.name not in known.added() or dialect != known.dialect(dialect.name):
        load(dialect)
        known.add(dialect)

"""What the interpreter asks of Caffe's forks: their fields, layer types and layers.

:class:`Forks` has the answers of Caffe alone. ``netspec/__init__.py`` says who has better ones (netspec/dialects); they
are imported at the first question. This file imports nothing by itself, so that it can come before everything else.
"""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from typing import Any


class Forks:
    """The answers where no fork is known: a prototxt has Caffe's fields and layers, or is refused.

    A *dialect* is what one fork adds. Messages are named in full, ``caffe.LayerParameter``.
    """

    new_layer = ""  # how a user adds a layer type that nobody has, for an error
    new_field = ""  # how a user adds a field that nobody has

    def use(self, name: "str | Path") -> None:
        """Add a dialect: see :func:`use_dialect`."""
        from netspec.errors import SpecError

        raise SpecError(f'dialect "{name}" is unknown: this netspec was installed without netspec/dialects')

    # The language

    def named_in(self, text: str, file: str) -> "tuple[str, ...]":
        """Switch on the dialects that a prototxt names, and return their names. Raises SpecError for an unknown one."""
        return ()

    def add_field(self, message: str, field: str, text: str, start: int, file: str) -> bool:
        """Add a field that Caffe's message lacks, with all of its dialect; return whether one dialect has it.

        What is given for it begins at character ``start`` of the text of ``file``.
        """
        return False

    def add_value(self, message: str, field: str, value: str, file: str) -> bool:
        """Add a value that an enum of Caffe's lacks, with all of its dialect; return whether one dialect has it."""
        return False

    def with_field(self, message: str, field: str) -> "tuple[str, ...]":
        """Return the dialects that have a field; "" is any message."""
        return ()

    def with_value(self, message: str, field: str, value: str) -> "tuple[str, ...]":
        """Return the dialects that add a value to an enum of Caffe's, that of a field of a message."""
        return ()

    def with_type(self, layer_type: str) -> "tuple[str, ...]":
        """Return the dialects that have a layer type."""
        return ()

    def with_message(self, name: str) -> "tuple[str, ...]":
        """Return the dialects that have a message or an enum of their own, named without its package."""
        return ()

    def layer_types(self) -> "set[str]":
        """Return the layer types of all dialects."""
        return set()

    def advice(self, name: str, dialects: "tuple[str, ...]") -> str:
        """Return how a user gets ``name``, which these dialects have; "" where there are none."""
        return ""

    def active(self) -> "list[tuple[str, str, str]]":
        """Return the name, file and declarations of each dialect whose fields are in the schema now."""
        return []

    def schema_file(self) -> "Any":
        """Return the descriptor of caffe.proto with the active dialects' additions; None where there are none."""
        return None

    # The layers

    def register_type(self, layer_type: str) -> None:
        """Register the layers of the dialect that alone has a layer type, if there is one."""

    def class_of(self, param: "Any", options: "Any") -> "Any":
        """Return the class that the dialects of a net have for a layer; None where it is that of its type."""
        return None

    def dialects_of(self, net: "Any") -> "set[str]":
        """Return the dialects whose fields and layer types a NetParameter has, and those that count for every net."""
        return set()

    def is_loose(self, layer: "Any") -> bool:
        """Return whether the files of forks have a layer's blobs with other axes of size 1."""
        return False

    def rewrite(self, plan: "Any", dialects: "Any") -> "list[str]":
        """Change the layers of a Plan whose forks read their fields in another way; return warnings."""
        return []

    def doubts(self, layers: "Any") -> "dict[str, int]":
        """Return warnings of layers whose type several forks have, where nothing shows which is meant.

        With each goes the index of the first of the layers that it is about.
        """
        return {}


_caffe = Forks()
_known: "list[Forks]" = []
find: "Callable[[], Forks | None]" = lambda: None  # noqa: E731  # set by netspec/__init__.py


def forks() -> Forks:
    """Return who answers for the forks."""
    if not _known:
        _known.append(find() or _caffe)
    return _known[0]


def use_dialect(name: "str | Path") -> None:
    """Add the fields and layers of a dialect, given by its name or the path of its file, for the whole process.

    Does nothing where it is there already. Raises SpecError where there is no such dialect, its file has a fault, or
    Caffe or another dialect has one of its fields or layer types.
    """
    forks().use(name)

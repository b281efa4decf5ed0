"""The interface to Caffe's forks: their fields, layer types and layers.

:class:`Forks` is the implementation for Caffe alone. ``netspec/__init__.py`` registers the one with forks
(netspec/dialects), which is imported at its first use. This file imports nothing, so every other file can import it.
"""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from typing import Any


class Forks:
    """The implementation without forks: a prototxt with fields or layers that Caffe lacks is refused.

    A *dialect* is the additions of one fork. Messages have full names, such as ``caffe.LayerParameter``.
    """

    new_layer = ""  # advice for adding an unknown layer type, for errors
    new_field = ""  # advice for adding an unknown field

    def use(self, name: "str | Path") -> None:
        """Add a dialect: see :func:`use_dialect`."""
        from netspec.errors import SpecError

        raise SpecError(f'dialect "{name}" is unknown: netspec/dialects is missing from this installation')

    # Fields

    def named_in(self, text: str, file: str) -> "tuple[str, ...]":
        """Activate the dialects that a prototxt names; return their names. Raises SpecError for an unknown one."""
        return ()

    def add_field(self, message: str, field: str, text: str, start: int, file: str) -> bool:
        """Add a field that Caffe's message lacks, by activating its dialect; return whether exactly one dialect has it.

        Its value begins at character ``start`` of the text of ``file``.
        """
        return False

    def add_value(self, message: str, field: str, value: str, file: str) -> bool:
        """Add an enum value that Caffe lacks, by activating its dialect; return whether exactly one dialect has it."""
        return False

    def with_field(self, message: str, field: str) -> "tuple[str, ...]":
        """Return the dialects that have a field; "" is any message."""
        return ()

    def with_value(self, message: str, field: str, value: str) -> "tuple[str, ...]":
        """Return the dialects that add a value to one of Caffe's enums, given by a message and its field."""
        return ()

    def with_type(self, layer_type: str) -> "tuple[str, ...]":
        """Return the dialects that have a layer type."""
        return ()

    def with_message(self, name: str) -> "tuple[str, ...]":
        """Return the dialects that declare a message or an enum of this name, given without its package."""
        return ()

    def layer_types(self) -> "set[str]":
        """Return the layer types of all dialects."""
        return set()

    def advice(self, name: str, dialects: "tuple[str, ...]") -> str:
        """Return advice for using ``name``, which these dialects have; "" if there are none."""
        return ""

    def active(self) -> "list[tuple[str, str, str]]":
        """Return the name, file and declarations of each dialect whose fields are in the schema."""
        return []

    def schema_file(self) -> "Any":
        """Return the descriptor of caffe.proto with the additions of the active dialects; None if there are none."""
        return None

    # The solver

    def policies(self) -> "tuple[str, ...]":
        """Return the values of lr_policy that forks add."""
        return ()

    def rate_fields(self) -> "frozenset[str]":
        """Return the fields of SolverParameter from which forks compute the learning rate."""
        return frozenset()

    def policy_fault(self, param: "Any") -> str:
        """Return what a SolverParameter lacks for an lr_policy that a fork adds; "" if nothing is missing."""
        return ""

    def learning_rate(self, param: "Any", iteration: int, caffes: "Callable[[float], Any]") -> "Any":
        """Return the learning rate of an iteration; ``caffes`` computes Caffe's rate from a ``base_lr``."""
        return caffes(param.base_lr)

    # The layers

    def register_type(self, layer_type: str) -> None:
        """Register the layers of a dialect, if it is the only one with this layer type."""

    def class_of(self, param: "Any", options: "Any") -> "Any":
        """Return the class that replaces a layer's usual class in a net with these dialects; None if there is none."""
        return None

    def dialects_of(self, net: "Any") -> "set[str]":
        """Return the dialects whose fields and layer types a NetParameter uses, and those that apply to every net."""
        return set()

    def ignores_unit_axes(self, layer: "Any") -> bool:
        """Return whether weights of forks may store a layer's blobs with different axes of size 1."""
        return False

    def rewrite(self, plan: "Any", dialects: "Any") -> "list[str]":
        """Change the layers of a Plan whose forks interpret their fields differently; return warnings."""
        return []

    def doubts(self, layers: "Any") -> "dict[str, int]":
        """Return warnings about layers whose type exists in several forks, if the net does not show which is meant.

        Each comes with the index of the first of its layers.
        """
        return {}


_caffe = Forks()
_known: "list[Forks]" = []
find: "Callable[[], Forks | None]" = lambda: None  # noqa: E731  # set by netspec/__init__.py


def forks() -> Forks:
    """Return the registered implementation."""
    if not _known:
        _known.append(find() or _caffe)
    return _known[0]


def use_dialect(name: "str | Path") -> None:
    """Add the fields and layers of a dialect to the whole process. It is given by its name or the path of its file.

    Does nothing if it is already active. Raises SpecError if there is no such dialect, its file has an error, or
    Caffe or another dialect already has one of its fields or layer types.
    """
    forks().use(name)

"""The interface to Caffe's forks: their fields, layer types and layers.

A *dialect* is what one fork adds. Reading a text changes nothing in the process: a net has the dialects that its text
names, and those whose fields and layer types it uses. :class:`Forks` is the implementation for Caffe alone.
``netspec/__init__.py`` registers the one with forks (netspec/dialects), which is imported at its first use. This file
imports nothing, so every other file can import it.
"""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping
    from pathlib import Path
    from typing import Any

    from netspec.proto.schema import Field, LayerParameter, NetParameter, SolverParameter

    Names = tuple[str, ...]


class Additions:
    """What the known dialects add, and which of them have it. Messages have full names: ``caffe.LayerParameter``.

    ``fields`` is by message and field, ``values`` by message, field and added value of its enum, ``types`` by layer
    type, ``messages`` by the name of a message or an enum without its package. ``advice`` says, by dialect, how to use
    it.
    """

    def __init__(self) -> None:
        self.fields: dict[tuple[str, str], Names] = {}
        self.values: dict[tuple[str, str, str], Names] = {}
        self.types: dict[str, Names] = {}
        self.messages: dict[str, Names] = {}
        self.advice: dict[str, str] = {}

    def with_field(self, field: str) -> "Names":
        """Return the dialects that have a field of any message."""
        return tuple(sorted({name for (_, each), names in self.fields.items() if each == field for name in names}))

    def advise(self, name: str, dialects: "Names") -> str:
        """Return advice for using ``name``, which these dialects have; "" if there are none."""
        if not dialects:
            return ""
        several = len(dialects) > 1
        listed = " and ".join(f'"{dialect}"' for dialect in dialects)
        advice = f"; {self.advice[dialects[0]]}" if self.advice[dialects[0]] else ""
        if several:
            advice += f'{", or" if advice else ";"} write "# dialect: {dialects[0]}" into the prototxt'
        return f'dialect{"s" if several else ""} {listed} {"have" if several else "has"} "{name}"{advice}'


class Rates:
    """The learning rates of forks; here there are none.

    ``policies`` are values of lr_policy, ``fields`` those of SolverParameter from which a rate is computed.
    """

    policies: "Names" = ()
    fields: "frozenset[str]" = frozenset()

    def fault(self, param: "SolverParameter") -> str:
        """Return what a solver lacks for one of the policies; "" if nothing is missing."""
        return ""

    def rate(self, param: "SolverParameter", iteration: int, caffes: "Callable[[float], Any]") -> "Any":
        """Return the learning rate of an iteration; ``caffes`` computes Caffe's rate from a ``base_lr``."""
        return caffes(param.base_lr)


class Forks:
    """The implementation without forks: a prototxt with fields or layers that Caffe lacks is refused."""

    new_layer = ""  # advice for adding an unknown layer type, for errors
    new_field = ""  # advice for adding an unknown field
    everywhere: "Names" = ()  # the dialects that a user requested for every net of the process
    rates = Rates()

    def use(self, name: "str | Path") -> None:
        """Add a dialect to ``everywhere``: see :func:`use_dialect`."""
        from netspec.errors import SpecError

        raise SpecError(f'dialect "{name}" is unknown: netspec/dialects is missing from this installation')

    def additions(self) -> Additions:
        """Return what the known dialects add."""
        return Additions()

    def named_in(self, text: str, file: str) -> "Names":
        """Return the dialects that the comments of a prototxt name. Raises SpecError for an unknown one."""
        return ()

    def field(self, dialect: str, message: str, name: str) -> "Field":
        """Return the field with which a dialect extends a message, or the values of the enum of its field."""
        raise NotImplementedError

    def schema_file(self, dialects: "Collection[str]" = ()) -> "Any":
        """Return the descriptor of caffe.proto with what ``everywhere`` and dialects add; None if there are none."""
        return None

    def sources(self) -> "list[tuple[str, str, str]]":
        """Return the names, files and declarations of ``everywhere``."""
        return []

    # The layers

    def adopt(self, cls: "Any", module: str) -> bool:
        """Keep a class of layers that a module registers; return whether it is the module of a dialect."""
        return False

    def class_of(self, param: "LayerParameter", dialects: "Collection[str]", runs_python: bool) -> "Any":
        """Return the class of a layer of these dialects that Caffe lacks, or that replaces Caffe's; None without one.

        ``runs_python``: Python layers may run their own code.
        """
        return None

    def dialects_of(self, net: "NetParameter") -> "set[str]":
        """Return the dialects whose fields and layer types a net uses, and those of ``everywhere``."""
        return set()

    def applied_to(self, plan: "Any", dialects: "Collection[str]") -> "Any":
        """Return a new Plan with its dialects: the given ones, those that its text names, and those that it uses.

        Its layers have the fields that these dialects mean, and its ``warnings`` say what they changed.
        """
        return plan

    def doubts(self, layers: "Any") -> "Mapping[str, int]":
        """Return warnings about layers whose type exists in several forks, if the net does not show which is meant.

        Each comes with the index of the first of its layers.
        """
        return {}


_known: "list[Forks]" = []
find: "Callable[[], Forks | None]" = lambda: None  # noqa: E731  # set by netspec/__init__.py


def forks() -> Forks:
    """Return the registered implementation."""
    if not _known:
        _known.append(find() or Forks())
    return _known[0]


def use_dialect(name: "str | Path") -> None:
    """Add the fields and layers of a dialect to every net of the process. It is given by its name or by its file.

    Does nothing if it was added before. Raises SpecError if there is no such dialect, its file has an error, or Caffe
    or another added dialect already has one of its fields or layer types.
    """
    forks().use(name)

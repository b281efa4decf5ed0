"""The interface to Caffe's forks: their fields, layer types and layers.

A *dialect* is what one fork adds. The reader asks for the fields that a text uses, and :meth:`Forks.meaning` says,
between parsing and planning, what the layers of a net are. :class:`Forks` is the implementation for Caffe alone.
``netspec/__init__.py`` registers the one with forks (netspec/dialects), which is imported at its first use. This file
imports nothing, so every other file can import it.
"""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path
    from typing import Any

    from netspec.proto.schema import Field, LayerParameter, NetParameter, SolverParameter
    from netspec.proto.source_map import SourceMap

    Names = tuple[str, ...]


class Additions:
    """What the known dialects add, and which of them have it. Messages have full names: ``caffe.LayerParameter``.

    ``fields`` is by message and field, ``values`` by message, field and added value of its enum, ``types`` by layer
    type, ``messages`` by the name of a message or an enum without its package. ``elsewhere`` names the forks of types
    that no dialect has.
    """

    def __init__(self) -> None:
        self.fields: dict[tuple[str, str], Names] = {}
        self.values: dict[tuple[str, str, str], Names] = {}
        self.types: dict[str, Names] = {}
        self.messages: dict[str, Names] = {}
        self.elsewhere: dict[str, str] = {}

    def with_field(self, field: str) -> "Names":
        """Return the dialects that have a field of any message."""
        return tuple(sorted({name for (_, each), names in self.fields.items() if each == field for name in names}))

    def advise(self, name: str, dialects: "Names") -> str:
        """Return advice for using ``name``, which these dialects have; "" if there is none."""
        if not dialects:
            fork = self.elsewhere.get(name) or self.elsewhere.get(name.title().replace("_", ""))  # MAT_WRITE
            return f"it is of {fork}, and not here" if fork else ""
        first, *others = (f'"{dialect}"' for dialect in dialects)
        have = f"dialects {' and '.join([first, *others])} have" if others else f"dialect {first} has"
        use = f"add --plugin {dialects[0]}, in Python netspec.use_dialect({first})"
        return f'{have} "{name}"; {use}, or write a line "# dialect: {dialects[0]}" into the prototxt'


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


class Meaning:
    """What a net means by the forks that it uses, ``dialects``; here nothing. ``net`` is the net that is built.

    By index of the layer: ``classes`` that Caffe lacks or that replace Caffe's, None where two forks were reported,
    and ``forks`` of types that several have.
    """

    def __init__(self, net: "NetParameter", dialects: "Names" = ()) -> None:
        self.net = net
        self.dialects = dialects
        self.classes: dict[int, Any] = {}
        self.forks: dict[int, str] = {}
        self.warnings: list[str] = []


class Forks:
    """The implementation without forks: a prototxt with fields or layers that Caffe lacks is refused."""

    new = ""  # how to add a layer type or a field that is unknown, for errors
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

    def meaning(self, net: "NetParameter", source: "SourceMap", options: "Any") -> Meaning:
        """Return what a filtered net means, with BuildOptions. A layer of two forks is reported to ``source``."""
        return Meaning(net)

    def class_of(self, param: "LayerParameter") -> "Any":
        """Return the class of a layer by itself that Caffe lacks, or that replaces Caffe's; None without one."""
        return None

    def adopt(self, cls: "Any", module: str) -> bool:
        """Keep a class of layers that a module registers; return whether it is the module of a dialect."""
        return False

    def schema_file(self, dialects: "Collection[str]" = ()) -> "Any":
        """Return the descriptor of caffe.proto with what ``everywhere`` and dialects add; None if there are none."""
        return None

    def sources(self) -> "list[tuple[str, str, str]]":
        """Return the names, files and declarations of ``everywhere``."""
        return []


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
    already has one of its fields or layer types.
    """
    forks().use(name)

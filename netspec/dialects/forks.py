"""Implements the interface in netspec/proto/forks.py with the dialects."""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

from typing_extensions import override

from netspec.dialects import known, registry
from netspec.dialects.blocks.settings import SettingsRates
from netspec.dialects.files import find_file, read_dialect
from netspec.dialects.signatures import SIGNATURES, fork_of
from netspec.errors import SpecError, Where
from netspec.proto.forks import Additions, Forks, Meaning
from netspec.proto.schema import Field, LayerParameter, NetParameter
from netspec.proto.source_map import SourceMap

NAMED = re.compile(r"^[ \t]*#[ \t]*dialect:[ \t]*(\w+)[ \t]*\r?$", re.MULTILINE)


class Dialects(Forks):
    """The dialects in this folder, and in files that a user named."""

    new = "docs/layer.md shows how to add one with --plugin FILE.py"
    rates = SettingsRates()

    @property
    def everywhere(self) -> tuple[str, ...]:
        """The dialects that a user added for every net."""
        return known.added()

    @override
    def use(self, name: str | Path) -> None:
        from netspec.dialects.layers import load  # imported here, since it needs torch

        dialect = read_dialect(find_file(name))
        if dialect.name not in known.added() or dialect != known.dialect(dialect.name):
            load(dialect)
            known.add(dialect)

    @override
    def additions(self) -> Additions:
        return known.known()

    @override
    def named_in(self, text: str, file: str) -> tuple[str, ...]:
        names = []
        for found in NAMED.finditer(text):
            try:
                names.append(found[1] if found[1] in known.added() else find_file(found[1]).name)
            except SpecError as fault:
                raise SpecError(fault.message, Where(file, text.count("\n", 0, found.start(1)) + 1, 1)) from None
        return tuple(names)

    @override
    def field(self, dialect: str, message: str, name: str) -> Field:
        return registry.field(known.dialect(dialect), message, name)

    @override
    def meaning(self, net: NetParameter, source: SourceMap, options: Any) -> Meaning:
        from netspec.dialects.layers import class_of, dialects_of
        from netspec.dialects.segmentation.crops import with_aligned_crops

        requested = {*known.added(), *options.dialects}
        shown = source.dialects, requested, {*source.dialects, *requested, *dialects_of(net)}
        net, warnings = with_aligned_crops(net, source, shown[-1])
        meaning, doubts = Meaning(net, tuple(sorted(shown[-1]))), dict[str, Where]()
        for i, layer in enumerate(net.layer):
            where = source.at(i, "type", layer=layer.name, type=layer.type)
            try:
                if cls := class_of(layer, shown, options.allow_python):
                    meaning.classes[i] = cls
                if (
                    cls and layer.type in SIGNATURES and cls.__module__.startswith("netspec.dialects.")
                ):  # no user's layer
                    meaning.forks[i], doubt = fork_of(layer, shown)
                    doubts.setdefault(doubt, where)
            except SpecError as fault:
                source.report(SpecError(fault.message, fault.where or where))
                meaning.classes.setdefault(i)
        meaning.warnings = [*warnings, *(f"{where}: {doubt}" for doubt, where in doubts.items() if doubt)]
        return meaning

    @override
    def class_of(self, param: LayerParameter) -> Any:
        from netspec.dialects.layers import class_of, dialects_of

        try:
            return class_of(param, (known.added(), {*known.added(), *dialects_of(NetParameter(layer=[param]))}))
        except SpecError:
            return None

    @override
    def adopt(self, cls: Any, module: str) -> bool:
        owner = known.dialect_of_module(module)
        if owner:
            from netspec.dialects.layers import CLASSES

            cls.takes_empty = False
            CLASSES.setdefault(cls.type, {})[owner] = cls
        return bool(owner)

    @override
    def schema_file(self, dialects: Collection[str] = ()) -> Any:
        from netspec.dialects.merged import merged_file

        return merged_file(tuple(known.dialect(name) for name in sorted({*known.added(), *dialects})))

    @override
    def sources(self) -> list[tuple[str, str, str]]:
        found = [known.dialect(name) for name in sorted(known.added())]
        return [(each.name, each.file, each.source) for each in found]

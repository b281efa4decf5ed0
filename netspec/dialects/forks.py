"""Implements the interface in netspec/proto/forks.py with the dialects."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from typing_extensions import override

from netspec.dialects import registry, use_dialect
from netspec.dialects.blocks.settings import SettingsRates
from netspec.dialects.files import find_file
from netspec.dialects.known import added, dialect_of_module, known
from netspec.dialects.known import dialect as find
from netspec.errors import SpecError, Where
from netspec.proto.forks import Additions, Forks, Rates
from netspec.proto.schema import Field, LayerParameter, NetParameter

NAMED = re.compile(r"^[ \t]*#[ \t]*dialect:[ \t]*(\w+)[ \t]*\r?$", re.MULTILINE)


class Dialects(Forks):
    """The dialects in this folder, in installed packages, and in files that a user named."""

    new_layer = "docs/layer.md shows how to add one with --plugin FILE.py"
    new_field = "docs/layer.md shows how to add a fork's with --plugin FILE.py"
    rates: Rates = SettingsRates()

    @property
    def everywhere(self) -> tuple[str, ...]:
        """The dialects that a user added for every net."""
        return added()

    @override
    def use(self, name: str | Path) -> None:
        use_dialect(name)

    @override
    def additions(self) -> Additions:
        return known()

    @override
    def named_in(self, text: str, file: str) -> tuple[str, ...]:
        names = []
        for found in NAMED.finditer(text):
            line = text.count("\n", 0, found.start(1)) + 1
            try:
                names.append(find_file(found[1]).name)
            except SpecError as fault:
                raise SpecError(fault.message, Where(file, line, 1)) from None
        return tuple(names)

    @override
    def field(self, dialect: str, message: str, name: str) -> Field:
        return registry.field(find(dialect), message, name)

    @override
    def schema_file(self, dialects: Collection[str] = ()) -> Any:
        from netspec.dialects.merged import merged_file

        return merged_file(tuple(find(name) for name in sorted({*added(), *dialects})))

    @override
    def sources(self) -> list[tuple[str, str, str]]:
        found = [find(name) for name in sorted(added())]
        return [(each.name, each.file, each.source) for each in found]

    @override
    def adopt(self, cls: Any, module: str) -> bool:
        owner = dialect_of_module(module)
        if owner:
            from netspec.dialects.layers import adopt

            adopt(cls, owner)
        return bool(owner)

    @override
    def class_of(self, param: LayerParameter, dialects: Collection[str], runs_python: bool) -> Any:
        from netspec.dialects.layers import class_of

        return class_of(param, dialects, runs_python)

    @override
    def dialects_of(self, net: NetParameter) -> set[str]:
        from netspec.dialects.layers import dialects_of

        return dialects_of(net)

    @override
    def applied_to(self, plan: Any, dialects: Collection[str]) -> Any:
        from netspec.dialects.segmentation.crops import with_aligned_crops

        used = {*dialects, *plan.source.dialects, *self.dialects_of(plan.net)}
        return with_aligned_crops(replace(plan, dialects=tuple(sorted(used))))

    @override
    def doubts(self, layers: Any) -> Mapping[str, int]:
        from netspec.dialects.signatures import doubt

        found: dict[str, int] = {}
        for i, layer in enumerate(layers):
            if message := doubt(layer):
                found.setdefault(message, i)
        return found

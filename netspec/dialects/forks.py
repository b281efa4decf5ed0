"""Implements the interface in netspec/proto/forks.py with the dialects."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from typing_extensions import override

from netspec import log
from netspec.dialects import registry, use_dialect
from netspec.dialects.files import activate_file, announce_known, find_file, known_files
from netspec.errors import SpecError, Where
from netspec.proto.forks import Forks

NAMED = re.compile(r"^[ \t]*#[ \t]*dialect:[ \t]*(\w+)[ \t]*\r?$", re.MULTILINE)


class Dialects(Forks):
    """The dialects in this folder, in installed packages, and in files that a user named."""

    new_layer = "docs/layer.md shows how to add one with --plugin FILE.py"
    new_field = "docs/layer.md shows how to add a fork's with --plugin FILE.py"

    @override
    def use(self, name: str | Path) -> None:
        use_dialect(name)

    @override
    def named_in(self, text: str, file: str) -> tuple[str, ...]:
        names = []
        for found in NAMED.finditer(text):
            line = text.count("\n", 0, found.start(1)) + 1
            try:
                dialect = find_file(found[1])
            except SpecError as fault:
                raise SpecError(fault.message, Where(file, line, 1)) from None
            activate_file(dialect)
            names.append(dialect.name)
        return tuple(names)

    @override
    def add_field(self, message: str, field: str, text: str, start: int, file: str) -> bool:
        """If several dialects have the field, choose the only one whose message has the given inner fields."""
        dialects = self.with_field(message, field)
        if len(dialects) > 1:
            inside = set(re.findall(r"\w+", text[start : text.find("}", start)]))
            dialects = registry.dialects_with_inner_fields(dialects, inside)
        return _activated(dialects, file)

    @override
    def add_value(self, message: str, field: str, value: str, file: str) -> bool:
        return _activated(self.with_value(message, field, value), file)

    @override
    def with_field(self, message: str, field: str) -> tuple[str, ...]:
        announce_known()
        return registry.dialects_with_field(message, field)

    @override
    def with_value(self, message: str, field: str, value: str) -> tuple[str, ...]:
        announce_known()
        return registry.dialects_with_value(message, field, value)

    @override
    def with_type(self, layer_type: str) -> tuple[str, ...]:
        announce_known()
        return registry.dialects_with_type(layer_type)

    @override
    def with_message(self, name: str) -> tuple[str, ...]:
        announce_known()
        return registry.dialects_with_message(name)

    @override
    def layer_types(self) -> set[str]:
        announce_known()
        return {each for dialect in registry.known() for each in dialect.layer_types}

    @override
    def advice(self, name: str, dialects: tuple[str, ...]) -> str:
        return registry.advice_for(name, dialects)

    @override
    def active(self) -> list[tuple[str, str, str]]:
        return [(dialect.name, dialect.file, dialect.source) for dialect in registry.active_dialects()]

    @override
    def schema_file(self) -> Any:
        from netspec.dialects.merged import merged_file

        return merged_file()

    @override
    def register_type(self, layer_type: str) -> None:
        from netspec.dialects.layers import register_type

        register_type(layer_type)

    @override
    def class_of(self, param: Any, options: Any) -> Any:
        from netspec.dialects.layers import class_of

        return class_of(param, options)

    @override
    def policies(self) -> tuple[str, ...]:
        from netspec.dialects.blocks.settings import POLICIES

        return POLICIES

    @override
    def rate_fields(self) -> frozenset[str]:
        from netspec.dialects.blocks.settings import RATE_FIELDS

        return RATE_FIELDS

    @override
    def policy_fault(self, param: Any) -> str:
        from netspec.dialects.blocks.settings import policy_fault

        return policy_fault(param)

    @override
    def learning_rate(self, param: Any, iteration: int, caffes: Callable[[float], Any]) -> Any:
        from netspec.dialects.blocks.settings import learning_rate

        return learning_rate(param, iteration, caffes)

    @override
    def dialects_of(self, net: Any) -> set[str]:
        from netspec.dialects.layers import dialects_of

        return dialects_of(net)

    @override
    def rewrite(self, plan: Any, dialects: Any) -> list[str]:
        if not any(layer.type == "Crop" for layer in plan.net.layer):
            return []
        from netspec.dialects.segmentation.crops import align_crops

        return list(align_crops(plan, dialects))

    @override
    def ignores_unit_axes(self, layer: Any) -> bool:
        from netspec.dialects.signatures import ignores_unit_axes

        return ignores_unit_axes(layer)

    @override
    def doubts(self, layers: Any) -> dict[str, int]:
        from netspec.dialects.signatures import doubt

        found: dict[str, int] = {}
        for i, layer in enumerate(layers):
            if message := doubt(layer):
                found.setdefault(message, i)
        return found


def _activated(dialects: Collection[str], file: str) -> bool:
    """Activate a dialect if it is the only one; return whether it is."""
    own = [name for name in dialects if name in known_files()]
    if len(own) != 1:
        return False
    activate_file(find_file(own[0]))
    log.logger.info(f"{file}: switched on the layers and fields of {own[0]}")
    return True

"""The dialects that can be found, by name, and those that a user added for every net of the process."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

from netspec import log
from netspec.dialects.files import OF_FILES, known_files, read_dialect
from netspec.dialects.registry import Dialect, check, check_beside, declare
from netspec.errors import SpecError
from netspec.proto.forks import Additions

_OWN = f"{__package__}."
_added: dict[str, Dialect] = {}  # for every net of the process


def known() -> Additions:
    """Return what all known dialects add."""
    return _additions(tuple(_added.values()))


def added() -> tuple[str, ...]:
    """Return the names of the dialects that a user added for every net."""
    return tuple(_added)


def dialect(name: str) -> Dialect:
    """Return a known dialect."""
    return _added.get(name) or _found()[name]


def add(given: Dialect) -> None:
    """Add a dialect for every net."""
    _added[given.name] = given


def to_add(given: Dialect) -> Dialect | None:
    """Return a dialect that is to be added for every net, None if it was already. Raises SpecError if it cannot be."""
    if given == _added.get(given.name):
        return None
    check(given)
    if given.module.startswith(OF_FILES):
        for each in _found().values():
            declare(each)  # so that they keep their numbers
        declare(given)
    check_beside(given, list(_added.values()))
    return given


def dialect_of_module(module: str) -> str:
    """Return the name of the dialect with a module; "" if it belongs to none."""
    if module.startswith(_OWN):
        return module.rpartition(".")[2]
    if module.startswith(OF_FILES):
        return module.removeprefix(OF_FILES)
    return next((name for name, file in known_files().items() if file.module == module), "")


@cache
def _found() -> dict[str, Dialect]:
    """Return the dialects in this folder and in packages. A file that cannot be read is ignored with a warning."""
    found = {}
    for file in known_files().values():
        try:
            each = read_dialect(file)
            check(each)
        except SpecError as fault:
            log.logger.warning(f'dialect "{file.name}" is ignored: {fault}')
        else:
            found[each.name] = each
    return found


@cache
def _additions(added: tuple[Dialect, ...]) -> Additions:
    found = Additions()
    for each in sorted({**_found(), **{one.name: one for one in added}}.values(), key=lambda one: one.name):
        _enter(found.fields, each, each.fields())
        _enter(found.values, each, [(*key, value) for key, values in each.values().items() for value in values])
        _enter(found.types, each, each.layer_types)
        _enter(found.messages, each, each.messages())
        found.advice[each.name] = each.advice
    return found


def _enter(table: dict, each: Dialect, keys: Iterable) -> None:
    for key in keys:
        table[key] = (*table.get(key, ()), each.name)

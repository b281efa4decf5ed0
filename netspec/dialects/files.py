"""Finding the files of dialects, and reading their declarations without running them.

``DECLARATIONS`` and the types of the layers are read from a file's syntax (how to write one: netspec/dialects), so
that a hint about a dialect needs no torch.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from netspec.dialects.registry import Dialect
from netspec.errors import SpecError, Where, did_you_mean
from netspec.files.kinds import unreadable

OF_FILES = "netspec_dialect_"  # begins the names of modules that are given by their paths


class DialectFile(NamedTuple):
    """A file that has not been read. ``module`` is the name of its module."""

    name: str
    path: Path
    module: str


@cache
def known_files() -> dict[str, DialectFile]:
    """Return netspec's own dialects by name."""
    found = {}
    for path in sorted(Path(__file__).parent.glob("*/*.py"), key=lambda path: path.stem):
        if "\nDECLARATIONS = " in path.read_text("utf-8"):
            found[path.stem] = DialectFile(path.stem, path, f"{__package__}.{path.parent.name}.{path.stem}")
    return found


def find_file(name: str | Path) -> DialectFile:
    """Return the file of a dialect, given by its name or by a path that ends in .py. Raises SpecError."""
    path, files = Path(name), known_files()
    if path.suffix == ".py":
        name = re.sub(r"\W", "_", path.stem)
        return DialectFile(name, path, f"{OF_FILES}{name}")
    if str(name) not in files:
        expected = f"; expected one of: {', '.join(files)}, or the path of a .py file"
        raise SpecError(f'unknown dialect "{name}"{did_you_mean(str(name), list(files)) or expected}')
    return files[str(name)]


def read_dialect(file: DialectFile) -> Dialect:
    """Return what a file declares. Raises SpecError if it cannot be read or declares nothing."""
    try:
        tree = ast.parse(file.path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError) as fault:
        raise SpecError(unreadable(file.path, fault), Where(str(file.path))) from None
    except SyntaxError as fault:
        where = Where(str(file.path), fault.lineno or 0, fault.offset or 0)
        raise SpecError(f"this is not valid Python: {fault.msg}", where) from None
    source = ""
    for node in tree.body:
        if isinstance(node, ast.Assign) and any(_name(target) == "DECLARATIONS" for target in node.targets):
            if not (isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)):
                where = Where(str(file.path), node.lineno, node.col_offset + 1)
                raise SpecError("DECLARATIONS must be one plain string: it is read without running the file", where)
            # Prepend blank lines, so that errors have the line numbers of the file.
            source = "\n" * (node.value.lineno - 1) + node.value.value
    types = tuple(_registered_types(tree))
    if not source and not types:
        raise SpecError("declares no dialect: neither DECLARATIONS nor a layer with @register", Where(str(file.path)))
    return Dialect(file.name, source, types, str(file.path), file.module)


def _registered_types(tree: ast.Module) -> Iterator[str]:
    """Yield the types under which new layers are registered."""
    for call in ast.walk(tree):
        if isinstance(call, ast.Call) and _name(call.func) == "register" and call.args:
            first = call.args[0]
            if isinstance(first, ast.Constant) and isinstance(first.value, str):
                yield first.value


def _name(node: ast.expr) -> str:
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""

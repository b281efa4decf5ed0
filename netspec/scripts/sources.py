"""From a program's text to code: Python 2 is translated, and what NumPy's arrays have lost is called by its new name.

The same is done to modules that a program imports from outside of Python's own folders.
"""

from __future__ import annotations

import ast
import importlib.abc
import linecache
import sys
import sysconfig
import warnings
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from netspec.errors import SpecError, Where
from netspec.files.whole_file import whole_file
from netspec.scripts import python2

RENAMED_METHODS = {"tostring": "tobytes"}  # of arrays, called without arguments


def main_code(data: bytes, path: str, is_python2: bool, keep: Path | None) -> CodeType:
    """Return the code of a program; ``keep`` is where its translation from Python 2 is written.

    Raises SyntaxError where it is neither Python 3 nor Python 2, SpecError where Python 2 cannot be translated here, or
    there is no translation to keep.
    """
    if not (is_python2 or python2.is_python2(data, path)):
        if keep:
            raise SpecError(f"is Python 3 already: there is no translation to write to {keep}", Where(path))
        return _compiled(data, path)
    where = f"is in {keep}" if keep else "is kept by --write-py3 FILE"
    print(f"netspec run: {path} is Python 2, and runs translated to Python 3; the translation {where}", file=sys.stderr)
    text = python2.translated(data, path)
    if keep:
        with whole_file(keep) as unfinished:
            unfinished.write_text(text, "utf-8", errors="surrogateescape")
    return _compiled(text, path)


def module_code(data: bytes, path: str) -> CodeType:
    """Return the code of a module of a program. Raises as :func:`main_code`."""
    if not python2.is_python2(data, path):
        return _compiled(data, path)
    print(f"netspec run: {path} is Python 2 too", file=sys.stderr)
    return _compiled(python2.translated(data, path), path)


def _compiled(source: str | bytes, path: str) -> CodeType:
    """Return the code of Python 3; the lines of a text that is not in the file are known to tracebacks."""
    if isinstance(source, str):
        linecache.cache[path] = (len(source), None, source.splitlines(keepends=True), path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of escapes in strings and the like: the script is old
        return compile(_Renaming().visit(ast.parse(source, path)), path, "exec", dont_inherit=True)


def install() -> None:
    """Read the modules that are imported from now on in this way, but for those of Python and of site-packages."""
    sys.meta_path.insert(0, _Finder())


class _Renaming(ast.NodeTransformer):
    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.func, ast.Attribute) and not node.args and not node.keywords:
            node.func.attr = RENAMED_METHODS.get(node.func.attr, node.func.attr)
        return node


class _Finder(importlib.abc.MetaPathFinder):
    """Finds the modules of programs, where Python's own finder does."""

    def __init__(self) -> None:
        names = ("stdlib", "platstdlib", "purelib", "platlib")
        self.others = tuple({sysconfig.get_path(name) for name in names} | {str(Path(__file__).parents[2] / "netspec")})

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        spec = PathFinder.find_spec(fullname, path)
        if spec is None or type(spec.loader) is not SourceFileLoader or not self._is_programs(spec):
            return None
        spec.loader = _Loader(fullname, str(spec.origin))
        return spec

    def _is_programs(self, spec: ModuleSpec) -> bool:
        origin = str(spec.origin)
        return not origin.startswith(self.others) and not {"site-packages", "dist-packages"} & set(Path(origin).parts)


class _Loader(SourceFileLoader):
    """Compiles by :func:`module_code`, and keeps no compiled file: plain Python would take it."""

    def get_code(self, fullname: str) -> CodeType:
        return module_code(self.get_data(self.path), self.path)

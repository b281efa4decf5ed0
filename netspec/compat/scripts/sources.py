"""From a program's text to code: Python 2 is translated, and what NumPy's arrays have lost is given back.

The same is done to modules that a program imports from outside of Python's own folders.
"""

from __future__ import annotations

import ast
import builtins
import importlib.abc
import linecache
import os
import sys
import sysconfig
import warnings
from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from netspec.compat.scripts import python2
from netspec.errors import SpecError, Where
from netspec.files.whole_file import write_whole

MAIN = "__netspec_main__"  # by this name a worker imports the program
RENAMED_METHODS = {"tostring": "tobytes"}  # of arrays, called without arguments
_FORMAT, _CALL = "__netspec_format__", "__netspec_call__"  # builtins of programs


def write_translation(path: str, out: Path, always: bool) -> None:
    """Write a program of Python 2 as Python 3 that needs nothing of netspec; ``always`` also where it is Python 3 too.

    Raises SyntaxError where it is neither, SpecError where it is Python 3 already, cannot be read, or Python 2 cannot
    be translated here.
    """
    data = bytes_of(path)
    if not (always or python2.is_python2(data, path)):
        raise SpecError(f"is Python 3 already: there is no translation to write to {out}", Where(path))
    write_whole(out, python2.translated(data, path, alone=True), "surrogateescape")


def bytes_of(path: str) -> bytes:
    """Return a program's bytes. Raises SpecError where it cannot be read."""
    try:
        return Path(path).read_bytes()
    except OSError as fault:
        raise SpecError(f"{path}: cannot be read: {fault.strerror}") from None


class Reader(importlib.abc.MetaPathFinder):
    """Reads a program and its modules, but for those of Python and of site-packages.

    A module without syntax of either language is Python 2 where the program is, and it lies beside or below the
    program or in a folder that the program has put on ``sys.path``; with ``always`` wherever it lies.
    """

    def __init__(self, folder: str, always: bool) -> None:
        self.folder = os.path.realpath(folder)
        self.always = self.python2 = always
        self.given = frozenset(os.path.realpath(entry) for entry in sys.path)
        self.main: str | None = None  # the program's path
        self.quiet = False
        self._others = ()

    def install(self) -> None:
        """Read the modules that are imported from now on."""
        ours = Path(__file__).parents[3]
        others = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
        self._others = (*others, *(str(ours / name) for name in ("netspec", "loopclosure", "lmdb_build")))
        setattr(builtins, _FORMAT, _format)
        setattr(builtins, _CALL, _call)
        sys.meta_path.insert(0, self)

    def main_code(self, data: bytes, path: str) -> CodeType:
        """Return the code of the program.

        Raises SyntaxError where it is neither Python 3 nor Python 2, SpecError where Python 2 cannot be translated.
        """
        self.main = path
        self.python2 = self.always or python2.is_python2(data, path)
        kept = "--write-py3 FILE writes the translation"
        return self._code(data, path, self.python2, f"is Python 2, and runs translated to Python 3; {kept}")

    def module_code(self, data: bytes, path: str) -> CodeType:
        """Return the code of a module of the program. Raises as :meth:`main_code`."""
        is_python2 = python2.is_python2(data, path) or (
            self.python2 and self._is_neighbor(path) and not python2.is_python3(data, path)
        )
        return self._code(data, path, is_python2, "is Python 2 too")

    def _code(self, data: bytes, path: str, is_python2: bool, said: str) -> CodeType:
        if not is_python2:
            return _compiled(data, path)
        if not self.quiet:
            print(f"netspec run: {path} {said}", file=sys.stderr)
        return _compiled(python2.translated(data, path), path)

    def _is_neighbor(self, path: str) -> bool:
        folders = {self.folder, *({os.path.realpath(entry) for entry in sys.path} - self.given)}
        place = Path(os.path.realpath(path))
        return self.always or any(place.is_relative_to(folder) for folder in folders)

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        """Return the spec of a module of the program, which is found where Python finds it, or None."""
        if fullname == MAIN and self.main:
            return spec_from_file_location(MAIN, self.main, loader=_Loader(MAIN, self.main, self.main_code))
        spec = PathFinder.find_spec(fullname, path)
        if spec is None or type(spec.loader) is not SourceFileLoader or not self._is_programs(spec):
            return None
        spec.loader = _Loader(fullname, str(spec.origin), self.module_code)
        return spec

    def _is_programs(self, spec: ModuleSpec) -> bool:
        origin = str(spec.origin)
        return not origin.startswith(self._others) and not {"site-packages", "dist-packages"} & set(Path(origin).parts)


class _Loader(SourceFileLoader):
    """Compiles as a :class:`Reader` does, and keeps no compiled file: plain Python would take it."""

    def __init__(self, fullname: str, path: str, code: Callable[[bytes, str], CodeType]) -> None:
        super().__init__(fullname, path)
        self._code = code

    def get_code(self, fullname: str) -> CodeType:
        return self._code(self.get_data(self.path), self.path)


def _compiled(source: str | bytes, path: str) -> CodeType:
    """Return the code of Python 3; the lines of a text that is not in the file are known to tracebacks."""
    if isinstance(source, str):
        linecache.cache[path] = (len(source), None, source.splitlines(keepends=True), path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of escapes in strings and the like: the script is old
        tree = ast.fix_missing_locations(_GivingBack().visit(ast.parse(source, path)))
        return compile(tree, path, "exec", dont_inherit=True)


class _GivingBack(ast.NodeTransformer):
    """Writes calls for what arrays could do: ``a.tostring()``, ``"%f" % a`` and ``float(a)`` of one element."""

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        function = node.func
        if isinstance(function, ast.Attribute) and not node.args and not node.keywords:
            function.attr = RENAMED_METHODS.get(function.attr, function.attr)
        named = isinstance(function, ast.Name) and function.id in ("float", "int")
        of_math = isinstance(function, ast.Attribute) and getattr(function.value, "id", "") == "math"
        takes_one = len(node.args) == 1 and not node.keywords and not isinstance(node.args[0], ast.Starred)
        if (named or of_math) and takes_one:
            return ast.copy_location(_calling(_CALL, function, node.args[0]), node)
        return node

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        self.generic_visit(node)
        text = isinstance(node.left, ast.Constant) and isinstance(node.left.value, str)
        if text and isinstance(node.op, ast.Mod):
            return ast.copy_location(_calling(_FORMAT, node.left, node.right), node)
        return node


def _calling(name: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(ast.Name(name, ast.Load()), list(arguments), [])


def _format(text: str, values: Any) -> str:
    """Return text % values; arrays of one element are numbers, as they were before NumPy 2.4."""
    try:
        return text % values
    except TypeError:
        given = values if isinstance(values, tuple) else (values,)
        numbers = tuple(map(_number, given))
        if all(number is value for number, value in zip(numbers, given, strict=True)):
            raise
        return text % numbers


def _call(function: Callable[[Any], Any], value: Any) -> Any:
    """Return function(value) likewise."""
    try:
        return function(value)
    except TypeError:
        number = _number(value)
        if number is value:
            raise
        return function(number)


def _number(value: Any) -> Any:
    """Return the element of an array that has one; everything else as it is."""
    is_array = hasattr(value, "dtype") and getattr(value, "ndim", 0) > 0 and value.size == 1
    return value.item() if is_array else value

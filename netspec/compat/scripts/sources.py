"""From a program's text to code: Python 2 is translated, and what NumPy's arrays have lost is given back.

The same is done to modules that a program imports from outside of Python's own folders.
"""

from __future__ import annotations

import ast
import builtins
import functools
import importlib.abc
import linecache
import os
import re
import sys
import sysconfig
import warnings
from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from netspec.compat.scripts import mended, old_names, python2
from netspec.compat.scripts.mended import MENDED
from netspec.errors import SpecError, Where
from netspec.files.whole_file import write_whole

MAIN = "__netspec_main__"  # by this name a worker imports the program
RENAMED_METHODS = {"tostring": "tobytes"}  # of arrays, called without arguments
_LOOK_AT_THEIR_CALLER = ("namedtuple", "Enum", "_getframe", "warn")  # a call in between would be it


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
        for name, function in mended.BUILTINS.items():
            setattr(builtins, MENDED.format(name), function)
        sys.meta_path.insert(0, self)

    def main_code(self, data: bytes, path: str) -> CodeType:
        """Return the code of the program.

        Raises SyntaxError where it is neither Python 3 nor Python 2, SpecError where Python 2 cannot be translated.
        """
        self.main = path
        self.python2 = self.always or python2.is_python2(data, path)
        kept = "--write-py3 FILE writes the translation"
        return self._code(data, path, self.python2, f"is Python 2, and runs translated to Python 3; {kept}")

    def module_code(self, data: bytes, path: str, package: str) -> CodeType:
        """Return the code of a module of the program, in a package unless that is "". Raises as :meth:`main_code`."""
        is_python2 = python2.is_python2(data, path) or (
            ((self.python2 and self._is_neighbor(path)) or _imports_beside(data, path, package))
            and not python2.is_python3(data, path)
        )
        return self._code(data, path, is_python2, "is Python 2 too")

    def _code(self, data: bytes, path: str, is_python2: bool, said: str) -> CodeType:
        if not is_python2:
            return _compiled(data, path)
        if not self.quiet:
            print(f"netspec run: {path} {said}", file=sys.stderr)
        mended.TRANSLATED.add(path)
        return _compiled(python2.translated(data, path), path, is_python2=True)

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
        package = fullname if spec.submodule_search_locations else fullname.rpartition(".")[0]
        read = functools.partial(self.module_code, package=package)
        spec.loader = _Loader(fullname, str(spec.origin), read)
        return spec

    def _is_programs(self, spec: ModuleSpec) -> bool:
        origin, top = Path(str(spec.origin)), spec.name.partition(".")[0]
        folder = next((place.parent for place in origin.parents if place.name == top), origin.parent)
        return not (
            top in old_names.PACKAGES
            or str(origin).startswith(self._others)
            or {"site-packages", "dist-packages"} & set(origin.parts)
            or {top, f"{top}.py"} & _installed(folder)
        )


@functools.cache
def _installed(folder: Path) -> frozenset[str]:
    """Return the names that pip has put into a folder (pip install --target)."""
    records = (record.read_text("utf-8", "replace") for record in folder.glob("*.dist-info/RECORD"))
    return frozenset(re.split("[/,]", line, maxsplit=1)[0] for text in records for line in text.splitlines())


def _imports_beside(data: bytes, path: str, package: str) -> bool:
    """Say whether a module of a package imports another by a bare name that nothing else has, as in Python 2."""
    folder = Path(path).parent
    beside = {name for name in python2.imported_names(data, path) if package and _is_in(name, folder)}
    return any(name not in sys.modules and PathFinder.find_spec(name) is None for name in beside)


def _is_in(name: str, folder: Path) -> bool:
    return (folder / f"{name}.py").is_file() or (folder / name / "__init__.py").is_file()


def builtins_for(path: str) -> Any:
    """Return the builtins of a module: in Python 2 an import looks beside the module first, if that is in a package."""
    return {**vars(builtins), "__import__": _import} if path in mended.TRANSLATED else builtins


def _import(name: str, names: Any = None, own: Any = None, wanted: Sequence[str] = (), level: int = 0) -> Any:
    package = (names or {}).get("__package__")
    if level == 0 and package and "absolute_import" not in names:
        top = f"{package}.{name.partition('.')[0]}"
        places = getattr(sys.modules.get(package), "__path__", None)
        level = int(top in sys.modules or (places is not None and PathFinder.find_spec(top, places) is not None))
    return builtins.__import__(name, names, own, wanted, level)


class _Loader(SourceFileLoader):
    """Compiles as a :class:`Reader` does, and keeps no compiled file: plain Python would take it."""

    def __init__(self, fullname: str, path: str, code: Callable[[bytes, str], CodeType]) -> None:
        super().__init__(fullname, path)
        self._code = code

    def get_code(self, fullname: str) -> CodeType:
        return self._code(self.get_data(self.path), self.path)

    def exec_module(self, module: ModuleType) -> None:
        code = self.get_code(module.__name__)
        vars(module)["__builtins__"] = builtins_for(self.path)
        exec(code, vars(module))


def _compiled(source: str | bytes, path: str, is_python2: bool = False) -> CodeType:
    """Return the code of Python 3; the lines of a text that is not in the file are known to tracebacks."""
    if isinstance(source, str):
        linecache.cache[path] = (len(source), None, source.splitlines(keepends=True), path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of escapes in strings and the like: the script is old
        tree = ast.fix_missing_locations(_GivingBack(is_python2).visit(ast.parse(source, path)))
        return compile(tree, path, "exec", dont_inherit=True)


class _GivingBack(ast.NodeTransformer):
    """Writes calls for what arrays could do: ``a.tostring()``, ``"%f" % a`` and ``float(a)`` of one element.

    In Python 2 also for what text, bytes and values of unlike types could do: see netspec/compat/scripts/mended.py.
    """

    def __init__(self, is_python2: bool) -> None:
        self.is_python2 = is_python2
        self.functions = {"float", "int"} | ({"bytearray", "sorted", "print"} if is_python2 else set())

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.AST:
        if self.is_python2 and node.module in ("struct", "hashlib", "base64", "zlib", "binascii"):
            self.functions.update(alias.asname or alias.name for alias in node.names)
        return node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        function = node.func
        if isinstance(function, ast.Attribute):
            if not node.args and not node.keywords:
                function.attr = RENAMED_METHODS.get(function.attr, function.attr)
            if self.is_python2 and function.attr in ("decode", "encode") and not node.keywords:
                return ast.copy_location(_calling(MENDED.format(function.attr), function.value, *node.args), node)
            of_math = getattr(function.value, "id", "") == "math"
            mended = of_math or (self.is_python2 and function.attr not in _LOOK_AT_THEIR_CALLER)
        else:
            mended = isinstance(function, ast.Name) and function.id in self.functions
        if mended and (node.args or node.keywords):
            call = ast.Call(ast.Name(MENDED.format("call"), ast.Load()), [function, *node.args], node.keywords)
            return ast.copy_location(call, node)
        return node

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        self.generic_visit(node)
        text = isinstance(node.left, ast.Constant) and isinstance(node.left.value, str)
        if text and isinstance(node.op, ast.Mod):
            return ast.copy_location(_calling(MENDED.format("format"), node.left, node.right), node)
        return node

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        self.generic_visit(node)
        name = type(node.ops[0]).__name__.lower()
        if self.is_python2 and len(node.ops) == 1 and name in ("lt", "lte", "gt", "gte"):
            return ast.copy_location(
                _calling(MENDED.format(name.replace("te", "e")), node.left, node.comparators[0]), node
            )
        return node


def _calling(name: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(ast.Name(name, ast.Load()), list(arguments), [])

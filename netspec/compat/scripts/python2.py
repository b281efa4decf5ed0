"""Recognizes Python 2, and translates it to Python 3 that computes the same.

The translation is 2to3's (lib2to3 where Python still has it, else fissix, its fork), and adds what public programs for
Caffe need: the quotient of whole numbers is rounded down, ``round`` gives a float and rounds halves away from zero,
files are opened with Python 2's modes, and ``StringIO`` is a file of bytes (netspec/compat/scripts/as_python2.py).
Imports of a package's own modules by bare name are resolved at run time, because only then it is known what is imported
as a package. What else differs, such as text and bytes or the order of different types, mostly ends in an error;
old_names.py then says in which line, and what to write there.
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.util
import inspect
import io
import re
import tokenize
import warnings
from typing import Any

from netspec.compat.scripts import as_python2
from netspec.errors import SpecError, Where

# ---- Recognizing ----

_BUILTINS = frozenset(
    ("basestring", "cmp", "execfile", "file", "long", "raw_input", "reduce", "unichr", "unicode", "xrange")
)
_MODULES = frozenset(
    (
        "ConfigParser",
        "HTMLParser",
        "Queue",
        "SocketServer",
        "StringIO",
        "Tkinter",
        "__builtin__",
        "cPickle",
        "cStringIO",
        "commands",
        "cookielib",
        "copy_reg",
        "httplib",
        "thread",
        "urllib2",
        "urlparse",
        "xmlrpclib",
    )
)
_METHODS = frozenset(("has_key", "iteritems", "iterkeys", "itervalues"))
_ATTRIBUTES = frozenset((("sys", "maxint"), ("itertools", "izip"), ("itertools", "imap"), ("os", "getcwdu")))
_STATEMENTS = re.compile(
    rb"""^\s* (?: print \s+ [^\s(=] | print \s* $ | exec \s+ ["'\w] )
       | ^\s* (?: raise \s+ \w+ \s* , | except \s+ [^:\n]+ , \s* \w+ \s* : )
       | ^\#! .* python2""",
    re.MULTILINE | re.VERBOSE,
)


def is_python2(data: bytes, path: str) -> bool:
    """Return whether a file is Python 2: it parses only as Python 2, or uses something that only Python 2 has."""
    if re.match(rb"#!.*python2", data):
        return True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = ast.parse(data, path)
    except (SyntaxError, ValueError):
        if not _translator():
            return bool(_STATEMENTS.search(data))
        try:
            ast.parse(translated(data, path))
        except Exception:
            return False
        return True
    return not _has_python3(tree) and _has_python2(tree)


def is_python3(data: bytes, path: str) -> bool:
    """Return whether a file that parses as Python 3 would not parse as Python 2."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return _has_python3(ast.parse(data, path))


def imported_names(data: bytes, path: str) -> set[str]:
    """Return the first names of the modules that a file of Python 3 imports, but for relative imports."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        nodes = list(ast.walk(ast.parse(data, path)))
    whole = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    parts = [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom) and not node.level]
    return {name.partition(".")[0] for name in (*whole, *parts)}


def _has_python3(tree: ast.AST) -> bool:
    new = (ast.JoinedStr, ast.AnnAssign, ast.Nonlocal, ast.AsyncFunctionDef, ast.NamedExpr, ast.MatMult, ast.YieldFrom)
    future = {
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module == "__future__"
        for alias in node.names
    }
    future_print = "print_function" in future
    if "annotations" in future:
        return True
    for node in ast.walk(tree):
        if isinstance(node, new):
            return True
        if isinstance(node, ast.arguments) and (node.kwonlyargs or any(a.annotation for a in node.args)):
            return True
        if isinstance(node, ast.FunctionDef) and node.returns:
            return True
        if isinstance(node, ast.Call) and _name(node.func) == "super" and not node.args:
            return True
        if isinstance(node, ast.Call) and _name(node.func) == "print" and node.keywords and not future_print:
            return True
    return False


def _has_python2(tree: ast.AST) -> bool:
    """Return whether a file uses names or modules that only Python 2 has, without an alternative for Python 3."""
    bound = _bound_names(tree)
    guarded = {inner for node in ast.walk(tree) if isinstance(node, ast.Try) for inner in ast.walk(node)}
    for node in ast.walk(tree):
        if node in guarded:
            continue
        if isinstance(node, ast.Name) and node.id in _BUILTINS - bound:
            return True
        if _is_method_of_2(node):
            return True
        if isinstance(node, ast.Attribute) and (_name(node.value), node.attr) in _ATTRIBUTES:
            return True
        if isinstance(node, ast.Import) and any(_is_dropped(alias.name) for alias in node.names):
            return True
        if isinstance(node, ast.ImportFrom) and not node.level and _is_dropped(node.module or ""):
            return True
        if isinstance(node, ast.Expr) and _name(node.value) == "print":
            return True
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.RShift) and _name(node.left) == "print":
            return True
    return False


def _is_method_of_2(node: ast.AST) -> bool:
    """Return whether a node is d.has_key(k), d.iteritems() or the like, but not six.iteritems(d)."""
    if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
        return False
    return node.func.attr in _METHODS and len(node.args) == (node.func.attr == "has_key")


def _bound_names(tree: ast.AST) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load):
            names.add(node.id)
        elif isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        elif isinstance(node, ast.arg):
            names.add(node.arg)
        elif isinstance(node, ast.alias):
            names.add((node.asname or node.name).partition(".")[0])
    return names


def _is_dropped(module: str) -> bool:
    return module.partition(".")[0] in _MODULES and importlib.util.find_spec(module.partition(".")[0]) is None


def _name(node: ast.AST) -> str:
    return node.id if isinstance(node, ast.Name) else ""


# ---- Translating ----

_BUILTINS_OF_2 = ("file", "open", "round")  # those that are others in Python 2
_HELPERS = (*_BUILTINS_OF_2, "py2_div", "py2_divisor", "reduce", "intern", "reload")  # what import_helpers imports
_HOME = "netspec.compat.scripts.as_python2"
_ALONE = "as_python2"  # by this name a translation that needs no netspec imports from itself


@functools.cache
def translated(data: bytes, path: str, alone: bool = False) -> str:
    """Return Python 2 source as Python 3; ``alone`` puts what it needs into the text.

    Otherwise :func:`import_helpers` imports it without a new line, so that lines keep their numbers.
    Raises SyntaxError if it is not Python 2 either, and SpecError if neither lib2to3 nor fissix is installed.
    """
    package = _translator()
    if not package:
        advice = "pip install fissix, or pip install 'netspec-caffe[py2]'"
        raise SpecError(f"this is Python 2, and Python 3.13 and later have no translator for it: {advice}", Where(path))
    text = io.TextIOWrapper(io.BytesIO(data), _encoding(data), errors="surrogateescape").read()
    text = _spaces(text.rstrip() + "\n", package)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # lib2to3 warns that it is deprecated
            tree = _tool(package, _ALONE if alone else _HOME).refactor_string(text, path)
    except Exception as fault:  # each part of 2to3 has errors of its own
        raise SyntaxError(f"this is neither Python 3 nor Python 2: {fault}") from None
    helpers = [] if "division" in tree.future_features else _floor_quotients(tree, package)
    helpers += _used_builtins(tree)
    return _with_helpers(str(tree), helpers) if alone else str(tree)


@functools.cache
def _translator() -> str:
    """Return the package that translates: fissix, which is maintained, or else lib2to3, or ""."""
    return next((name for name in ("fissix", "lib2to3") if importlib.util.find_spec(name)), "")


@functools.cache
def _tool(package: str, home: str) -> Any:
    """Return 2to3, which takes StringIO from the module ``home``."""
    refactor = importlib.import_module(f"{package}.refactor")
    fixers = refactor.get_fixers_from_package(f"{package}.fixes")
    without = ["import"]
    if home == _HOME:  # these insert a line, which import_helpers does not
        without += ["reduce", "intern", "reload"]
    without += ["sorted"]  # it takes a.sort(0) of an array for a comparison
    without = [f"{package}.fixes.fix_{name}" for name in without]
    tool = refactor.RefactoringTool([name for name in fixers if name not in without])
    for fixer in (*tool.pre_order, *tool.post_order):
        if type(fixer).__name__ == "FixImports":
            fixer.mapping = {**fixer.mapping, "StringIO": home, "cStringIO": home}
    return tool


def _encoding(data: bytes) -> str:
    try:
        return tokenize.detect_encoding(io.BytesIO(data).readline)[0]
    except SyntaxError:  # no encoding is declared, and it is not UTF-8
        return "latin-1"


def _spaces(text: str, package: str) -> str:
    """Return a text indented by spaces. A tab reaches to the next multiple of 8, as in Python 2."""
    if "\t" not in text:
        return text
    tokens = importlib.import_module(f"{package}.pgen2.tokenize")
    token = importlib.import_module(f"{package}.pgen2.token")
    inside: set[int] = set()  # lines that begin in a string
    try:
        for kind, _, (first, _), (last, _), _ in tokens.generate_tokens(io.StringIO(text).readline):
            if kind == token.STRING:
                inside.update(range(first + 1, last + 1))
    except (tokens.TokenError, IndentationError):
        return text
    lines = text.splitlines(keepends=True)
    for number, line in enumerate(lines, 1):
        body = line.lstrip(" \t")
        if number not in inside:
            lines[number - 1] = line[: len(line) - len(body)].expandtabs(8) + body
    return "".join(lines)


def _floor_quotients(tree: Any, package: str) -> list[str]:
    """Replace each ``/`` and ``/=`` of operands that may be whole numbers by a call; return the called names."""
    pytree = importlib.import_module(f"{package}.pytree")
    util = importlib.import_module(f"{package}.fixer_util")
    syms = importlib.import_module(f"{package}.pygram").python_symbols
    used: set[str] = set()

    def call(name: str, left: Any, right: Any) -> Any:
        used.add(f"py2_{name}")
        prefix, left.prefix = left.prefix, ""
        right.prefix = right.prefix or " "
        return util.Call(util.Name(f"py2_{name}"), [left, util.Comma(), right], prefix=prefix)

    for node in list(tree.post_order()):
        operators = [str(child).strip() for child in node.children[1::2]]
        if node.type == syms.term and "/" in operators:
            parts = list(node.children)
            parent_slot = pytree.Leaf(1, "")
            node.replace(parent_slot)
            for part in parts:
                part.remove()
            left = parts[0]
            for operator, right in zip(parts[1::2], parts[2::2], strict=True):
                if operator.value == "/" and not (_is_float(left) or _is_float(right)):
                    left = call("div", left, right)
                else:
                    left = pytree.Node(syms.term, [left, operator, right])
            parent_slot.replace(left)
        elif node.type == syms.expr_stmt and operators == ["/="] and not _is_float(node.children[2]):
            value = node.children[2]
            value.remove()
            used.add("py2_divisor")
            value.prefix = ""
            node.append_child(util.Call(util.Name("py2_divisor"), [value], prefix=" "))
    return sorted(used)


def _is_float(node: Any) -> bool:
    """Return whether an operand is certainly a float: 2.0, or float(x)."""
    text = str(node).strip()
    return bool(re.fullmatch(r"(\d+\.\d*|\.\d+|\d+)([eE][-+]?\d+)?", text) and re.search(r"[.eE]", text)) or (
        text.startswith("float(") and text.endswith(")") and len(node.children) == 2
    )


def _used_builtins(tree: Any) -> list[str]:
    """Return the used builtins that differ in Python 2. x.open and file=f do not count."""
    named = (leaf for leaf in tree.leaves() if leaf.value in (*_BUILTINS_OF_2, _ALONE))
    used = {leaf.value for leaf in named if str(leaf.prev_sibling) != "." and str(leaf.next_sibling) != "="}
    return sorted(used)


def import_helpers(tree: ast.Module) -> None:
    """Add the imports of the helpers to a parsed translation."""
    used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    if names := [ast.alias(name) for name in _HELPERS if name in used]:
        first = _head(tree)
        line = (tree.body[first - 1].end_lineno or 1) if first else 1
        tree.body.insert(
            first, ast.ImportFrom(_HOME, names, 0, lineno=line, end_lineno=line, col_offset=0, end_col_offset=0)
        )


def _head(tree: ast.Module) -> int:
    """Return the number of statements of the docstring and the imports from __future__."""
    for number, node in enumerate(tree.body):
        docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and number == 0
        if not docstring and not (isinstance(node, ast.ImportFrom) and node.module == "__future__"):
            return number
    return len(tree.body)


def _with_helpers(text: str, helpers: list[str]) -> str:
    """Return a text with helpers, behind the docstring and the imports from __future__."""
    if not helpers:
        return text
    more = {
        **dict.fromkeys(("py2_div", "py2_divisor"), ("py2_is_whole",)),
        **dict.fromkeys(("file", "open"), ("open", "py2_bytes", "py2_writer")),
        _ALONE: ("StringIO", "py2_bytes"),
    }
    named = {*helpers, *(name for helper in helpers for name in more.get(helper, ()))} - {"file"}
    functions = [value for name, value in vars(as_python2).items() if name in named]  # in the order of the file
    parts = [inspect.getsource(function) for function in functions]
    line = "\n\n".join(
        ["import builtins\nimport decimal\nimport io\nimport math\nimport numbers\nimport sys\n", *parts]
    )
    line += "\n\nfile = open\n" if "file" in helpers else ""
    line += f"\n\nsys.modules[{_ALONE!r}] = sys.modules[__name__]\n\n" if _ALONE in helpers else "\n\n"
    tree = ast.parse(text)
    first = _head(tree)
    last = (tree.body[first - 1].end_lineno or 0) if first else 0
    lines = text.splitlines(keepends=True)
    if not last:  # behind the comments at the top: one may declare the encoding
        last = next((number for number, line in enumerate(lines) if not line.startswith("#")), 0)
    return "".join([*lines[:last], line, *lines[last:]])

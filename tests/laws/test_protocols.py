"""Optional methods of layers are documented once, by protocols; the class Layer has none of them."""

import ast
import inspect
from collections.abc import Iterator

from netspec.layers import Layer
from netspec.layers.contract import gradients, joining, reading
from netspec.layers.data.files import ReadingLayer
from paths import ROOT

MODULES = [gradients, joining, reading]


def members(cls: type) -> set[str]:
    return {name for name in (*vars(cls), *inspect.get_annotations(cls)) if not name.startswith("_")}


OFFERED = {
    name
    for module in MODULES
    for cls in vars(module).values()
    if inspect.isclass(cls) and getattr(cls, "_is_protocol", False) and cls.__module__ == module.__name__
    for name in members(cls)
}
HOOKS = members(Layer) | members(ReadingLayer)  # described there; what overrides them is not marked


def undescribed() -> Iterator[str]:
    for folder in ("layers", "dialects"):
        for path in sorted((ROOT / "netspec" / folder).rglob("*.py")):
            classes = [each for each in ast.walk(ast.parse(path.read_text())) if isinstance(each, ast.ClassDef)]
            public = [each for each in classes if not each.name.startswith("_")]
            for method in (method for cls in public for method in cls.body if isinstance(method, ast.FunctionDef)):
                marks = {ast.unparse(each).rpartition(".")[2] for each in method.decorator_list}
                known = method.name in OFFERED | HOOKS or marks & {"override", "staticmethod", "setter"}
                if not (known or method.name.startswith("_") or ast.get_docstring(method)):
                    yield f"{path.relative_to(ROOT)}:{method.lineno}: {method.name}"


def test_methods_outside_of_protocols_have_docstrings() -> None:
    assert list(undescribed()) == []


def test_layer_has_no_optional_methods() -> None:
    assert not OFFERED & set(vars(Layer))

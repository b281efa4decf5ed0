"""Layers of type Python, which run code written for pycaffe if this is allowed."""

import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from contexts import context
from netspec.errors import SpecError, Where
from netspec.layers import Layer, layer_class
from netspec.proto.schema import TRAIN, LayerParameter
from paths import PYTHON_LAYERS


@pytest.fixture
def python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Layer]]:
    """``python(class_name, *bottom_shapes, ...)``: one of tests/python_layers.py, from the current directory."""
    (tmp_path / "layers_of_mine.py").write_text(PYTHON_LAYERS.read_text())
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "layers_of_mine", raising=False)

    def build(
        name: str,
        *shapes: tuple[int, ...],
        module: str = "layers_of_mine",
        param_str: str = "",
        bottoms: tuple[str, ...] = ("a", "b", "c"),
        tops: tuple[str, ...] = ("top",),
        allow_python: bool = True,
        **facts,
    ) -> Layer:
        param = LayerParameter(name="mine", type="Python", bottom=bottoms[: len(shapes)], top=tops)
        param.python_param.module, param.python_param.layer, param.python_param.param_str = module, name, param_str
        at = lambda *path: Where("net.prototxt", 7, 3, "mine", "Python")  # noqa: E731
        python_layer = layer_class("Python")
        assert python_layer is not None
        return python_layer(param, shapes, context(allow_python=allow_python, at=at, **facts))

    yield build
    sys.modules.pop("layers_of_mine", None)


def test_python_code_runs_only_if_it_is_allowed(python) -> None:
    with pytest.raises(SpecError) as fault:
        python("TimesTen", (2, 3), allow_python=False)
    assert str(fault.value) == (
        'net.prototxt:7:3: layer "mine" (Python): a Python layer runs code named in the prototxt; pass '
        "--allow-python-layers if you trust it"
    )
    assert "layers_of_mine" not in sys.modules


def test_a_layer_built_without_data_has_the_given_shapes_and_runs_no_code(python) -> None:
    given = {"image": (1, 3, 8, 8), "label": (1,)}
    layer = python("Count", tops=("image", "label"), allow_python=False, open_data=False, given_shapes=given)
    assert layer.top_shapes == [(1, 3, 8, 8), (1,)]
    assert "layers_of_mine" not in sys.modules
    with pytest.raises(SpecError, match="--allow-python-layers"):
        python("Count", tops=("image", "other"), allow_python=False, open_data=False, given_shapes=given)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_python_layer_computes_tops_and_gradients_of_any_shape_and_dtype(python, dtype: torch.dtype) -> None:
    layer = python("TimesTen", (2, 3))
    assert layer.top_shapes == [(2, 3)]
    for shape in ((2, 3), (4, 5, 1)):
        bottom = torch.randn(shape, dtype=dtype, requires_grad=True)
        top = layer.run(bottom)[0]
        assert top.dtype == dtype
        assert torch.equal(top, 10 * bottom)
        diff = torch.randn(shape, dtype=dtype)
        top.backward(diff)
        assert bottom.grad is not None
        assert torch.equal(bottom.grad, 10 * diff)
    assert layer.top_shapes == [(4, 5, 1)]


def test_backward_is_told_which_bottoms_need_a_gradient(python) -> None:
    layer = python("Euclidean", (4, 3), (4, 3))
    a, b = torch.randn(4, 3, requires_grad=True), torch.randn(4, 3, requires_grad=True)
    loss = layer.run(a, b)[0]
    assert loss.shape == (1,)
    assert loss.item() == pytest.approx(((a - b) ** 2).sum().item() / 8, rel=1e-6)
    loss.sum().backward()
    assert a.grad is not None
    torch.testing.assert_close(a.grad, (a - b).detach() / 4)
    torch.testing.assert_close(b.grad, -a.grad)
    layer.run(a, b.detach())[0].sum().backward()
    assert layer.code.asked == [True, False]


def test_python_data_layer_keeps_state_and_reads_param_str(python) -> None:
    layer = python("Count", param_str="{'size': 3}")
    assert layer.top_shapes == [(3,)]
    batches = [layer.run()[0] for _ in range(3)]
    assert [batch.tolist() for batch in batches] == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]


def test_blobs_added_by_the_code_are_learned(python, gradcheck) -> None:
    layer = python("Learned", (4, 3))
    assert layer.blob_shapes == [(2, 3), (1,)]
    assert layer.blobs[0].tolist() == [[0.5] * 3] * 2
    with torch.no_grad():
        layer.blobs[0].copy_(torch.randn(2, 3))  # as a solver or a .caffemodel does
        layer.blobs[1].fill_(2)
    bottom = torch.randn(4, 3)
    expected = torch.nn.functional.linear(bottom, layer.blobs[0]) + 2
    torch.testing.assert_close(layer.run(bottom)[0], expected)
    gradcheck(layer, bottom)


def test_forward_can_change_the_shape_of_the_top(python) -> None:
    layer = python("Half", (4, 3), phase=TRAIN)
    top = layer.run(torch.arange(12.0).reshape(4, 3))[0]
    assert top.shape == (2, 3, 1, 1)
    assert top.flatten().tolist() == [0, 1, 2, 3, 4, 5]


def test_in_place_bottom_and_top_are_one_blob(python) -> None:
    for name, factor in (("Look", 1), ("Doubler", 2)):
        layer = python(name, (3,), bottoms=("x",), tops=("x",))
        bottom = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
        top = layer.run(bottom)[0]
        assert top.tolist() == [factor, 2 * factor, 3 * factor]
        assert bottom.tolist() == [1, 2, 3]  # other layers' gradients may need it
        top.backward(torch.tensor([5.0, 6.0, 7.0]))
        assert bottom.grad is not None
        assert bottom.grad.tolist() == [5 * factor, 6 * factor, 7 * factor]


def test_python_layer_without_tops_receives_its_bottoms(python) -> None:
    layer = python("Look", (2, 3), tops=())
    assert layer.run(torch.ones(2, 3)) == ()
    assert layer.code.seen.tolist() == [[1] * 3] * 2


def test_only_the_code_of_python_layers_can_import_caffe(python) -> None:
    python("TimesTen", (2, 3)).run(torch.ones(2, 3))
    assert "caffe" not in sys.modules
    assert str(Path.cwd()) not in sys.path[:1]


def test_an_installed_caffe_is_not_replaced(python, monkeypatch: pytest.MonkeyPatch) -> None:
    from netspec.layers.utility import pycaffe_shim

    real = types.ModuleType("caffe")
    monkeypatch.setattr(real, "Layer", type("Layer", (pycaffe_shim.Layer,), {}), raising=False)
    monkeypatch.setitem(sys.modules, "caffe", real)
    layer = python("TimesTen", (2, 3))
    assert isinstance(layer.code, real.Layer)
    assert sys.modules["caffe"] is real


def test_a_folder_named_caffe_is_not_imported_as_caffe(python, tmp_path: Path) -> None:
    (tmp_path / "caffe").mkdir()
    assert python("TimesTen", (2, 3)).run(torch.ones(2, 3))[0].sum() == 60


def test_a_missing_attribute_of_module_caffe_is_reported(
    python, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from netspec.layers.utility import pycaffe_shim

    monkeypatch.setattr(pycaffe_shim, "_home", pycaffe_shim.__name__)  # as if nobody had imported netspec.pycaffe
    (tmp_path / "wants_more.py").write_text("import caffe\nnet = caffe.Net('a', 'b', caffe.TEST)\n")
    with pytest.raises(SpecError, match="module caffe for Python layers has no Net; it has Layer, TRAIN and TEST"):
        python("Mine", (2,), module="wants_more")


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("TimesTen", {"module": "nowhere"}, 'cannot import module "nowhere" (looked for in the current directory and'),
        ("TimesTwn", {}, 'layers_of_mine.py) has no class "TimesTwn"; did you mean "TimesTen"?'),
        ("NoLayer", {}, "layers_of_mine.NoLayer is not a caffe.Layer"),
        ("Euclidean", {}, "layers_of_mine.Euclidean.setup: Exception: Need two inputs to compute distance. ("),
        ("Count", {"param_str": "{}"}, "layers_of_mine.Count.setup: KeyError: 'size' ("),
    ],
    ids=["missing_module", "missing_class", "not_a_layer", "exception_in_setup", "key_error_in_setup"],
)
def test_errors_of_the_code_are_reported_in_one_line(python, name: str, options: dict, message: str) -> None:
    with pytest.raises(SpecError) as fault:
        python(name, (2, 3), **options)
    text = str(fault.value)
    assert text.startswith('net.prototxt:7:3: layer "mine" (Python): ')
    assert message in text
    assert "\n" not in text


def test_python_2_syntax_is_reported_with_file_line_and_advice(python, tmp_path: Path) -> None:
    (tmp_path / "of_2014.py").write_text('import caffe\nprint "hello"\n')
    with pytest.raises(SpecError) as fault:
        python("Mine", (2,), module="of_2014")
    text = str(fault.value)
    assert "SyntaxError: " in text
    assert "of_2014.py:2); if it is Python 2, convert it with `fissix -w`" in text


FAULTY = """
import random
import caffe
import their_helper

class InRandom(caffe.Layer):
    def setup(self, bottom, top): random.sample(range(2), 3)

class InHelper(caffe.Layer):
    def setup(self, bottom, top): their_helper.fails()

class InNetspec(caffe.Layer):
    def setup(self, bottom, top):
        top[0].reshape("a")
"""


@pytest.mark.parametrize(
    ("name", "place"),
    [("InRandom", "faulty.py:7"), ("InHelper", "their_helper.py:2"), ("InNetspec", "faulty.py:14")],
    ids=["in_the_standard_library", "in_the_users_helper", "in_netspec"],
)
def test_errors_are_reported_at_a_line_of_the_users_files(python, tmp_path: Path, name: str, place: str) -> None:
    (tmp_path / "faulty.py").write_text(FAULTY)
    (tmp_path / "their_helper.py").write_text("def fails():\n    raise ValueError('bad')\n")
    with pytest.raises(SpecError) as fault:
        python(name, (2,), module="faulty")
    for module in ("faulty", "their_helper"):
        sys.modules.pop(module, None)
    assert str(fault.value).endswith(f"{place})")


def test_errors_in_reshape_and_a_missing_backward_name_the_method(python) -> None:
    layer = python("Euclidean", (2, 3), (2, 3))
    with pytest.raises(SpecError, match=r"layers_of_mine.Euclidean.reshape: Exception: Inputs must have the same dim"):
        layer.run(torch.ones(2, 3), torch.ones(2, 4))
    bottom = torch.ones(2, 3, requires_grad=True)
    top = python("Half", (2, 3)).run(bottom)[0]
    with pytest.raises(SpecError, match=r"layers_of_mine.Half.backward: AttributeError: "):
        top.sum().backward()

"""Every layer type: its docstring, shapes, gradient, results on a GPU, and error for a wrong number of bottoms."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch

from fake_gpu import NAME, POSSIBLE, fake_gpu
from gradients import check_gradients
from laws.examples import EXAMPLES, Shape
from netspec.errors import SpecError, Where
from netspec.graph.options import BuildOptions
from netspec.layers import Context, Layer, Random, layer_class, layer_types
from netspec.layers.data.memory import MemoryData
from netspec.proto.schema import TEST, LayerParameter
from paths import GOLDEN

TYPES = [name for name in layer_types() if getattr(layer_class(name), "__module__", "").startswith("netspec.layers.")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of small data for the layers that read files, and a module for layer Python."""
    folder = tmp_path_factory.mktemp("registry")
    cv2.imwrite(str(folder / "a.png"), np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8))
    (folder / "train_lmdb").symlink_to(GOLDEN / "pairs" / "train_lmdb")
    (folder / "train.txt").write_text("a.png 0\n")
    (folder / "windows.txt").write_text("# 0\na.png\n3\n20\n30\n2\n1 0.9 0 0 9 9\n0 0.1 5 5 19 19\n")
    with h5py.File(folder / "rows.h5", "w") as file:
        file["data"] = np.zeros((5, 2), np.float32)
    (folder / "files.txt").write_text(f"{folder}/rows.h5\n")
    (folder / "law_twice.py").write_text(
        "import caffe\n"
        "class Twice(caffe.Layer):\n"
        "    def setup(self, bottom, top): pass\n"
        "    def reshape(self, bottom, top): top[0].reshape(*bottom[0].data.shape)\n"
        "    def forward(self, bottom, top): top[0].data[...] = 2 * bottom[0].data\n"
        "    def backward(self, top, down, bottom): bottom[0].diff[...] = 2 * top[0].diff\n"
    )
    return folder


def build(name: str, folder: Path, shapes: Sequence[Shape], device: str = "cpu", exact: str = "small") -> Layer:
    param = LayerParameter()
    param.CopyFrom(EXAMPLES[name].param)
    param.bottom[:] = [f"bottom{i}" for i in range(len(shapes))]
    cls = layer_class(name)
    assert cls is not None

    def at(*path: str | int) -> Where:
        return Where(".".join(map(str, path)))

    options = BuildOptions(device, allow_python=True, exact=exact)
    return cls(param, shapes, Context(TEST, options, Random(0), at))


@pytest.fixture
def layer(request: pytest.FixtureRequest, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Layer]:
    """Return the example of a layer type in double precision; the parameter is the type and its ``exact``."""
    name, exact = request.param
    monkeypatch.chdir(folder)
    made = build(name, folder, EXAMPLES[name].shapes, exact=exact)
    if isinstance(made, MemoryData):
        made.set_input_arrays(np.zeros((4, 3, 4, 5)), np.zeros(4))
    yield made.double()
    made.close()


every_type = pytest.mark.parametrize("layer", [(name, "small") for name in TYPES], ids=TYPES, indirect=True)


def test_every_type_has_an_example() -> None:
    assert sorted(EXAMPLES) == TYPES


@every_type
def test_the_docstring_names_bottoms_tops_and_caffes_file(layer: Layer) -> None:
    lines = [line.strip() for line in (type(layer).__doc__ or "").splitlines()]
    assert lines[0].endswith((".", ":"))
    assert lines[1] == ""
    counts = {"bottom": layer.bottoms[1] != 0, "top": layer.tops[1] != 0}
    for kind, any_at_all in counts.items():
        described = [line for line in lines if re.match(rf"{kind}(\[[\w.-]+\])? +\S", line)]
        assert bool(described) or not any_at_all, kind
    for kind, count in (("bottom", len(layer.bottom_shapes)), ("top", layer.num_tops), ("blobs", len(layer.blobs))):
        named = {index for line in lines for index in re.findall(rf"^{kind}\[([\w.-]+)\] +\S", line)}
        assert all({str(k), "i"} & named or _in_a_range(k, named) for k in range(count)), f"{kind}: {named} of {count}"
    source = next(line for line in lines if line.startswith("Caffe: "))
    assert re.match(r"Caffe: (src|include)/caffe/layers/\w+_layer\.(cpp|hpp|cu)", source)


def _in_a_range(k: int, named: set[str]) -> bool:
    ranges = (name.split("..") for name in named if ".." in name)
    return any(int(first) <= k <= int(last) for first, last in ranges)


@every_type
def test_tops_and_blobs_have_the_declared_shapes(layer: Layer) -> None:
    example = EXAMPLES[layer.type]
    for times in (1, 3, 1) if example.batch is not None else (1,):
        tops = layer.run(*example.bottoms(times))
        assert len(tops) == layer.num_tops
        assert [tuple(top.shape) for top in tops] == layer.top_shapes
    assert [tuple(blob.shape) for blob in layer.blobs] == layer.blob_shapes


SMOOTH = [name for name in TYPES if EXAMPLES[name].smooth]
IN_CAFFES_ORDER = [pytest.param((name, "all"), id=f"{name}-all") for name in SMOOTH]
IN_TORCHS_ORDER = [pytest.param((name, "none"), id=f"{name}-none", marks=pytest.mark.slow) for name in SMOOTH]


@pytest.mark.parametrize("layer", [*IN_CAFFES_ORDER, *IN_TORCHS_ORDER], indirect=True)
def test_the_gradient_is_the_derivative(layer: Layer) -> None:
    bottoms = EXAMPLES[layer.type].bottoms()
    for i, bottom in enumerate(bottoms):
        whole_numbers = bool((bottom == bottom.round()).all())
        bottom.requires_grad_(not whole_numbers and i not in layer.label_bottoms)
    learned = [blob for j, blob in enumerate(layer.blobs) if layer.param_spec(j, None).lr_mult]

    def compute(*tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(top for top in layer.run(*tensors[: len(bottoms)]) if top.requires_grad)

    rtol = 1e-4 if layer.type == "ContrastiveLoss" else 1e-7  # its gradient ignores the 1e-4 added to the distance
    check_gradients(compute, (*bottoms, *learned), rtol)


@pytest.mark.slow
@pytest.mark.skipif(not POSSIBLE, reason="this torch cannot make a fake device")
@pytest.mark.parametrize("name", [name for name in TYPES if name != "Python"])  # whose code sees numpy arrays
def test_gpu_and_cpu_compute_the_same(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    example = EXAMPLES[name]
    found = []
    for device in ("cpu", NAME):
        with fake_gpu():
            layer = build(name, folder, example.shapes, device)
            if isinstance(layer, MemoryData):
                layer.set_input_arrays(np.zeros((4, 3, 4, 5)), np.zeros(4))
            bottoms = [bottom.float().to(device) for bottom in example.bottoms()]
            for i, bottom in enumerate(bottoms):
                bottom.requires_grad_(example.smooth and i not in layer.label_bottoms)
            tops = layer.run(*bottoms)
            learned = [top for top in tops if top.requires_grad]
            torch.autograd.backward(learned, [torch.ones_like(top) for top in learned])
            gradients = [tensor.grad for tensor in (*bottoms, *layer.blobs) if tensor.grad is not None]
            tensors = [*tops, *layer.blobs, *layer.buffers(), *gradients]
            assert {tensor.device.type for tensor in tensors} <= {device}
            found.append([tensor.detach().cpu() for tensor in tensors])
        layer.close()
    for on_cpu, on_gpu in zip(*found, strict=True):
        torch.testing.assert_close(on_gpu, on_cpu, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", TYPES)
def test_a_wrong_number_of_bottoms_is_refused(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    shapes = EXAMPLES[name].shapes
    least, most = layer_class(name).bottoms  # type: ignore[union-attr]
    wrong = [shapes[: least - 1]] if least else []
    if most is not None:
        wrong.append((*shapes, *[(2, 3)] * (most + 1 - len(shapes))))
    for given in wrong:
        with pytest.raises(SpecError, match=rf"^bottom: found {len(given)} bottom blob"):
            build(name, folder, given)
    assert wrong or name == "Python"

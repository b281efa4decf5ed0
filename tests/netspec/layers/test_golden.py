"""Every layer case that BVLC Caffe computed: outputs, input gradients, parameter gradients, running statistics."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

from fake_gpu import gpu
from golden_cases import LayerCase, promised
from paths import GOLDEN

CASES = sorted((GOLDEN / "layers").iterdir())
TOLERANCE = 1e-5  # of the largest element
REAL_GPU = 1e-4  # likewise: its libraries choose among algorithms that round differently


@pytest.fixture(params=["cpu", "fake", "cuda"])
def device(request: pytest.FixtureRequest) -> Iterator[str]:
    if request.param == "cpu":
        yield "cpu"
        return
    with gpu(request.param) as found:
        yield found


@pytest.mark.parametrize("exact", ["none", "small", "all"])
@pytest.mark.parametrize("folder", CASES, ids=lambda path: path.name)
def test_layer_computes_what_caffe_computed(
    folder: Path, exact: str, device: str, record_property: Callable[[str, object], None]
) -> None:
    case = LayerCase(folder)
    found = case.compute(exact, device)
    assert [key for key in found if key.startswith("out/")] == sorted(k for k in case.golden if k.startswith("out/"))
    worst = assert_close(found, case.golden, REAL_GPU if device.startswith("cuda") else TOLERANCE)
    record_property("off by", worst)


def assert_close(
    found: Mapping[str, np.ndarray], golden: Mapping[str, np.ndarray], tolerance: float = TOLERANCE
) -> float:
    """Return the largest difference, as a share of the array's largest element."""
    most = 0.0
    for key, value in found.items():
        expected = golden[key]
        assert value.shape == expected.shape, key
        scale = max(float(np.abs(expected).max(initial=0)), 1e-30)
        worst = float(np.abs(value.astype(np.float64) - expected).max(initial=0)) / scale
        assert worst <= tolerance, f"{key}: off by {worst:.2e} of the largest element"
        most = max(most, worst)
    return most


@pytest.mark.parametrize("exact", ["none", "small", "all"])
@pytest.mark.parametrize("folder", CASES, ids=lambda path: path.name)
def test_a_run_without_gradients_computes_the_same(folder: Path, exact: str) -> None:
    case = LayerCase(folder)
    assert_close(case.outputs(exact), case.golden)


@pytest.mark.parametrize(
    ("folder", "exact"),
    [pytest.param(case, exact, id=f"{case.name}-{exact}") for case in CASES for exact in promised(case)],
)
def test_layer_computes_caffes_bits(folder: Path, exact: str, same_blas: bool) -> None:
    if not same_blas:
        pytest.skip("another kind of CPU than Caffe's: its BLAS rounds differently")
    case = LayerCase(folder)
    for key, value in case.compute(exact).items():
        np.testing.assert_array_equal(value, case.golden[key], key)
    for key, value in case.outputs(exact).items():
        np.testing.assert_array_equal(value, case.golden[key], key)

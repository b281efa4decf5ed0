"""When sums are computed in Caffe's order, and when by torch's kernels."""

import pytest
import torch

from netspec.exact import SMALL_PRODUCT
from netspec.exact.blas import applies

CONVOLUTION = """
    layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 dim: 1 dim: 4 dim: 4 } } }
    layer { name: "conv" type: "Convolution" bottom: "data" top: "conv"
            convolution_param { num_output: 2 kernel_size: 3 weight_filler { type: "gaussian" } } }
    layer { name: "ip" type: "InnerProduct" bottom: "conv" top: "ip"
            inner_product_param { num_output: 3 weight_filler { type: "gaussian" } } }
    layer { name: "sigmoid" type: "Sigmoid" bottom: "ip" top: "sigmoid" }
"""


@pytest.mark.parametrize(
    ("exact", "small", "expected"),
    [("none", True, False), ("small", True, True), ("small", False, False), ("all", False, True)],
)
def test_the_option_exact_determines_what_is_computed_like_caffe(exact: str, small: bool, expected: bool) -> None:
    assert applies(exact, torch.ones(3), small) == expected
    assert not applies(exact, torch.ones(0), small)
    assert not applies(exact, torch.ones(3, dtype=torch.half), small)
    assert not applies(exact, torch.ones(3, device="meta"), small)


def functions(net) -> list[str]:
    """Return the names of the operations and autograd functions behind a net's output, the last first."""
    found, step = [], net(data=torch.randn(net.shapes["data"], requires_grad=True))["sigmoid"].grad_fn
    while step is not None:
        found.append(type(step.operation).__name__ if hasattr(step, "operation") else step.name())
        step = next((following for following, _ in step.next_functions if following is not None), None)
    return found


def test_the_limits_of_small_are_the_constants(net_of) -> None:
    names = functions(net_of(CONVOLUTION))
    assert "ColumnProducts" in names
    assert "VectorProducts" in names
    assert "PointwiseBackward" not in names  # a sigmoid is never among what is small
    pixels = int((SMALL_PRODUCT / (2 * 9)) ** 0.5) + 3
    large = functions(net_of(CONVOLUTION.replace("dim: 4 dim: 4", f"dim: {pixels} dim: {pixels}")))
    assert "ColumnProducts" not in large


def test_none_and_all_have_no_limit(net_of) -> None:
    assert not {"ColumnProducts", "VectorProducts"} & set(functions(net_of(CONVOLUTION, exact="none")))
    large = CONVOLUTION.replace("dim: 4 dim: 4", "dim: 300 dim: 300")
    names = functions(net_of(large, exact="all"))
    assert {"ColumnProducts", "VectorProducts", "PointwiseBackward"} <= set(names)


def test_another_word_is_refused(net_of) -> None:
    with pytest.raises(ValueError, match="found exact 'some', expected 'none', 'small', 'all'"):
        net_of(CONVOLUTION, exact="some")


def test_a_batch_without_images_is_accepted(net_of) -> None:
    assert net_of(CONVOLUTION, exact="all").layers[2].run(torch.zeros(0, 2, 2, 2))[0].shape == (0, 3)


@pytest.mark.slow
@pytest.mark.parametrize("exact", ["small", "all"])
@pytest.mark.filterwarnings("ignore")  # torch.jit.trace is deprecated, but in use
def test_a_recorded_net_computes_and_does_not_remember(net_of, exact: str) -> None:
    net = net_of(CONVOLUTION, exact=exact)
    for layer, shape in ((net.layers[1], (2, 1, 4, 4)), (net.layers[3], (2, 3))):
        data, other = torch.randn(2, *shape)
        traced = torch.jit.trace(layer, data, check_trace=False)
        assert isinstance(traced, torch.nn.Module)
        exported = torch.export.export(layer, (data,)).module()
        compiled = torch.compile(layer, backend="eager", fullgraph=True)
        for recorded in (traced, exported, compiled):
            torch.testing.assert_close(recorded(other), layer(other))

"""Runs without gradients: prepared, folded and fused, they give the results of a layer-by-layer run after any write."""

import copy
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from typing_extensions import override

from exported import trained
from netspec.errors import SpecError
from netspec.exact.blas import one_thread
from netspec.export.exporter import exporter_of
from netspec.fast import prepared
from netspec.fast.entry import Entry
from netspec.fast.table import entry_of
from netspec.graph.options import PASSES
from netspec.layers.activation import Sigmoid
from netspec.layers.contract.base import Layer
from netspec.layers.vision.convolution import Convolution
from netspec.net.net import Net
from netspec.net.weights import load_weights, write_binary
from netspec.proto.schema import TRAIN, LayerParameter

FILLERS = 'weight_filler { type: "gaussian" std: 0.2 } bias_filler { type: "uniform" min: -1 max: 1 }'
INPUT = 'layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 8 dim: 40 dim: 40 } } }'
CONV = f'type: "Convolution" convolution_param {{ num_output: 16 kernel_size: 3 pad: 1 {FILLERS} }}'
NORM = """
layer { name: "bn" type: "BatchNorm" bottom: "conv" top: "bn" }
layer { name: "scale" type: "Scale" bottom: "bn" top: "scale" scale_param { bias_term: true } }
layer { name: "relu" type: "ReLU" bottom: "scale" top: "scale" }
"""
BLOCK = INPUT + f'layer {{ name: "conv" bottom: "data" top: "conv" {CONV} }}' + NORM
NETS = {path.stem: path.read_text() for path in (Path(__file__).parent / "nets").glob("*.prototxt")}
SHARED = f"""
layer {{ name: "drop" type: "Dropout" bottom: "scale" top: "scale" }}
layer {{ name: "left" bottom: "scale" top: "left" {CONV} }}
layer {{ name: "right" bottom: "scale" top: "right" {CONV} }}
layer {{ name: "sum" type: "Eltwise" bottom: "left" bottom: "right" top: "sum" }}
layer {{ name: "end" type: "ReLU" bottom: "sum" top: "sum" }}
"""


def images(*shape: int) -> torch.Tensor:
    return torch.randn(*(shape or (1, 8, 40, 40)), generator=torch.Generator().manual_seed(3))


def slowly(net: Net, **inputs: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return what the net gives layer by layer."""
    with torch.enable_grad():
        return {name: blob.detach() for name, blob in net(**inputs).items()}


def quickly(net: Net, **inputs: torch.Tensor) -> dict[str, torch.Tensor]:
    with torch.no_grad():
        return net(**inputs)


def assert_same(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    assert list(found) == list(expected)
    for name, blob in expected.items():
        assert found[name].shape == blob.shape
        assert float((found[name] - blob).abs().max()) <= 1e-5 * max(1.0, float(blob.abs().max()))


def last_sequence(net: Net) -> prepared.KernelSequence:
    assert net.prepared is not None
    return next(reversed(net.prepared.sequences.values()))


def test_norms_fold_into_the_convolution_and_the_activation_fuses(net_of: Callable[..., Net]) -> None:
    net = trained(net_of(BLOCK))
    assert_same(quickly(net, data=images()), slowly(net, data=images()))
    sequence = last_sequence(net)
    (step,) = sequence.schedule.steps
    assert step.chain is not None
    assert [net.plan.nodes[i].name for i in (step.node, *step.chain.folded)] == ["conv", "bn", "scale"]
    assert step.activation is not None
    assert net.plan.nodes[step.activation].name == "relu"
    assert sequence.kinds == ["packed"]


def test_identity_layers_are_skipped_and_sums_are_computed_in_place(net_of: Callable[..., Net]) -> None:
    net = trained(net_of(BLOCK + SHARED))
    assert_same(quickly(net, data=images()), slowly(net, data=images()))
    steps = last_sequence(net).schedule.steps
    assert [net.plan.nodes[step.node].name for step in steps] == ["conv", "left", "right", "sum"]
    assert steps[-1].reuse


@pytest.mark.parametrize("how", ["num_output: 12", "num_output: 8 group: 8", "num_output: 8 group: 8 dilation: 2"])
def test_weights_of_deconvolutions_are_packed(how: str, net_of: Callable[..., Net]) -> None:
    layer = f'type: "Deconvolution" convolution_param {{ kernel_size: 4 stride: 2 pad: 1 {how} {FILLERS} }}'
    text = INPUT + f'layer {{ name: "conv" bottom: "data" top: "conv" {layer} }}' + NORM
    net = trained(net_of(text.replace('type: "ReLU"', 'type: "ReLU" relu_param { negative_slope: 0.1 }')))
    x = images(1, 8, 80, 80)
    assert_same(quickly(net, data=x), slowly(net, data=x))
    assert last_sequence(net).kinds == ["packed"]


@pytest.mark.parametrize("passes", [(), *((name,) for name in PASSES), PASSES], ids="-".join)
def test_each_pass_can_be_switched_off(passes: tuple[str, ...], net_of: Callable[..., Net]) -> None:
    net = trained(net_of(BLOCK + SHARED, passes=passes))
    assert_same(quickly(net, data=images()), slowly(net, data=images()))
    assert (net.prepared is None) == (not passes)


@pytest.mark.parametrize("keep", ["all", ["conv"], ["bn", "left"]], ids=str)
def test_requested_blobs_are_kept(keep: str | list[str], net_of: Callable[..., Net]) -> None:
    net = trained(net_of(BLOCK + SHARED))
    net.keep = keep
    slowly(net, data=images())
    expected = {name: blob.detach() for name, blob in net.blobs.items()}
    quickly(net, data=images())
    assert_same(net.blobs, expected)
    net.keep = ()
    quickly(net, data=images())
    assert list(net.blobs) == ["sum"]


def test_small_layers_keep_caffes_order_of_sums(net_of: Callable[..., Net]) -> None:
    text = BLOCK.replace("dim: 40 dim: 40", "dim: 6 dim: 6")
    net = trained(net_of(text))
    x = images(1, 8, 6, 6)
    np.testing.assert_array_equal(quickly(net, data=x)["scale"], slowly(net, data=x)["scale"])
    assert last_sequence(net).kinds == ["exact", "exact", "exact"]
    loose = trained(net_of(text, exact="none"))
    assert_same(quickly(loose, data=x), slowly(loose, data=x))
    assert len(last_sequence(loose).kinds) == 1


def write_in_place(net: Net) -> None:
    with torch.no_grad():
        net.params["conv"][0].mul_(2)


def write_to_data(net: Net) -> None:
    net.params["conv"][0].data[...] = 0.25


def write_by_numpy(net: Net) -> None:
    net.params["bn"][0].detach().numpy()[...] = 3


def give_other_data(net: Net) -> None:
    net.params["scale"][1].data = torch.full((16,), -0.5)


def replace_the_parameter(net: Net) -> None:
    net.layers[1].blobs[0] = torch.nn.Parameter(torch.full((16, 8, 3, 3), 0.1))


def load_other_weights(net: Net) -> None:
    path = net.plan.source.file  # of a test: no file has this name
    other = {name: [blob.detach() + 1 for blob in blobs] for name, blobs in net.params.items()}
    kept = {name: [blob.detach().clone() for blob in blobs] for name, blobs in net.params.items()}
    for values in (other, kept):
        with torch.no_grad():
            for name, blobs in net.params.items():
                for blob, value in zip(blobs, values[name], strict=True):
                    blob.copy_(value)
        if values is other:
            write_binary(net, path)
    load_weights(net, path)


@pytest.mark.parametrize(
    "write", [write_in_place, write_to_data, write_by_numpy, give_other_data, replace_the_parameter, load_other_weights]
)
def test_changed_parameters_are_used_in_the_next_run(
    write: Callable[[Net], None], net_of: Callable[..., Net], tmp_path: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(str(tmp_path))
    net = trained(net_of(BLOCK))
    before = quickly(net, data=images())["scale"]
    write(net)
    after = quickly(net, data=images())
    assert_same(after, slowly(net, data=images()))
    assert float((after["scale"] - before).abs().max()) > 1e-3
    for _ in range(2):
        assert_same(quickly(net, data=images()), slowly(net, data=images()))
    if write is not replace_the_parameter:  # a parameter of another class does not say what is written to it
        assert last_sequence(net).kinds == ["packed"]


def test_writes_through_an_alias_are_noticed(net_of: Callable[..., Net]) -> None:
    net = trained(net_of(BLOCK))
    quickly(net, data=images())
    held = net.params["conv"][0].detach().numpy()[1:]
    for value in (0.1, 0.2, 0.3):
        held[...] = value
        assert_same(quickly(net, data=images()), slowly(net, data=images()))
        assert last_sequence(net).kinds[0] == "as is"
    del held
    quickly(net, data=images())
    assert_same(quickly(net, data=images()), slowly(net, data=images()))
    assert last_sequence(net).kinds == ["packed"]


def test_a_write_through_a_view_is_noticed(net_of: Callable[..., Net]) -> None:
    net = trained(net_of(BLOCK))
    for value in (0.1, 0.2):
        quickly(net, data=images())
        net.params["conv"][0][1].data.fill_(value)
        assert_same(quickly(net, data=images()), slowly(net, data=images()))


def test_forward_hooks_are_called_without_gradients_too(net_of: Callable[..., Net]) -> None:
    net, called = trained(net_of(BLOCK)), list[str]()
    hooks = [layer.register_forward_hook(lambda module, *_: called.append(module.type)) for layer in net.layers[1:]]
    quickly(net, data=images())
    assert called == [layer.type for layer in net.layers[1:]]
    for hook in hooks:
        hook.remove()
    quickly(net, data=images())
    assert len(called) == len(hooks)


def test_deconvolutions_that_share_filters_have_buffers_of_their_own(net_of: Callable[..., Net]) -> None:
    """Their maps with zeros between the pixels have one size, but other pixels are zeros."""
    layer = """layer { name: "%s" type: "Input" top: "%s" input_param { shape { dim: 1 dim: 16 dim: %d dim: %d } } }
        layer { name: "of_%s" type: "Deconvolution" bottom: "%s" top: "of_%s" param { name: "w" } convolution_param {
            num_output: 16 group: 16 kernel_size: 4 pad: 1 bias_term: false stride: %d weight_filler { std: 1
            type: "gaussian" } } }"""
    sizes = {"a": (127, 1), "b": (64, 2)}
    net = net_of("".join(layer % (n, n, size, size, n, n, n, step) for n, (size, step) in sizes.items()), seed=1)
    inputs = {"a": images(1, 16, 127, 127), "b": images(1, 16, 64, 64)}
    for _ in range(2):
        assert_same(quickly(net, **inputs), slowly(net, **inputs))


def test_shapes_may_change_from_run_to_run(net_of: Callable[..., Net]) -> None:
    net = trained(net_of(BLOCK + SHARED))
    for shape in ((1, 8, 40, 40), (3, 8, 20, 31), (1, 8, 5, 5), (1, 8, 40, 40), (3, 8, 20, 31)):
        assert_same(quickly(net, data=images(*shape)), slowly(net, data=images(*shape)))
    assert net.prepared is not None
    assert len(net.prepared.sequences) == 3


@pytest.mark.parametrize("exact", ["none", "small"])
def test_sequences_are_kept_for_earlier_shapes(exact: str, net_of: Callable[..., Net]) -> None:
    net = trained(net_of(BLOCK + SHARED, exact=exact))
    sizes = (5, 40, 7)
    for size in sizes:
        quickly(net, data=images(1, 8, size, size))
    assert net.prepared is not None
    before = list(net.prepared.sequences.values())
    for size in sizes:
        quickly(net, data=images(1, 8, size, size))
    assert all(a is b for a, b in zip(net.prepared.sequences.values(), before, strict=True))
    assert "as is" not in {kind for sequence in before for kind in sequence.kinds}


@pytest.mark.parametrize(("runs", "fewest", "most"), [(prepared.MEMORY_FACTOR, 2, 16), (0, 1, 1)])
def test_the_memory_of_sequences_is_limited(
    runs: int, fewest: int, most: int, net_of: Callable[..., Net], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prepared, "MEMORY_FACTOR", runs)
    net = trained(net_of(BLOCK + SHARED))
    assert net.prepared is not None
    learned = sum(item.parameter.nbytes for item in net.learnable)
    for size in range(8, 24):
        quickly(net, data=images(1, 8, size, 9))
        made = net.prepared.sequences.values()
        limit = runs * (learned + max(sequence.needed_bytes for sequence in made))
        assert len(made) == 1 or net.prepared.kept_bytes() <= limit
        assert set().union(*(sequence.memos for sequence in made)) == set(net.prepared.memos)
    assert fewest <= len(net.prepared.sequences) <= most
    assert_same(quickly(net, data=images(1, 8, 8, 9)), slowly(net, data=images(1, 8, 8, 9)))


def test_nets_that_train_are_not_prepared(net_of: Callable[..., Net]) -> None:
    assert net_of(BLOCK, TRAIN).prepared is None


def test_inputs_and_earlier_outputs_are_never_overwritten(net_of: Callable[..., Net]) -> None:
    net, x = net_of(NETS["earlier_outputs"]), images()
    expected = slowly(net, data=x)
    first = quickly(net, data=x)
    assert torch.equal(x, images())
    assert_same(first, expected)
    quickly(net, data=-x)
    assert_same(first, expected)


@pytest.mark.parametrize("keep", [(), "conv", "all"])
@pytest.mark.parametrize("exact", ["small", "all"])
def test_products_reuse_memory_only_for_values_inside_the_net(
    exact: str, keep: str | tuple[str, ...], net_of: Callable[..., Net]
) -> None:
    net = net_of(NETS["shared_memory"], exact=exact)
    net.keep = keep
    given = [images(n, 8, 5, 4) * k for k, n in enumerate((3, 3, 1, 0, 3))]
    with one_thread():
        expected = [(slowly(net, data=x), dict(net.blobs)) for x in given]
        found = [(quickly(net, data=x), net.blobs) for x in given]
    for (outputs, kept), (wanted, all_wanted) in zip(found, expected, strict=True):
        for name, blob in {**wanted, **all_wanted}.items():
            assert torch.equal({**kept, **outputs}[name], blob), name


def test_layers_after_a_top_of_unknown_shape_run_by_value(net_of: Callable[..., Net]) -> None:
    net, x = trained(net_of(NETS["count_of_items"])), images(4, 8, 40, 40)
    for which in ([1, 0, 1, 1], [0, 1, 0, 0], [1, 1, 1, 1]):
        inputs = {"data": x, "which": torch.tensor(which, dtype=torch.float32)}
        assert_same(quickly(net, **inputs), slowly(net, **inputs))


def test_nan_is_never_the_maximum(net_of: Callable[..., Net]) -> None:
    pool = (
        'layer { name: "pool" type: "Pooling" bottom: "data" top: "pool" pooling_param { kernel_size: 2 stride: 2 } }'
    )
    net, x = net_of(INPUT + pool), images()
    x[0, 0, :3, :3] = torch.nan
    assert torch.equal(quickly(net, data=x)["pool"], slowly(net, data=x)["pool"])


def test_copies_precisions_and_threads(net_of: Callable[..., Net]) -> None:
    net = trained(net_of(BLOCK + SHARED))
    expected = quickly(net, data=images())
    other = copy.deepcopy(net)
    with torch.no_grad():
        other.params["conv"][0].zero_()
    assert_same(quickly(net, data=images()), expected)
    assert_same(quickly(other, data=images()), slowly(other, data=images()))
    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(lambda each: [quickly(each, data=images()) for _ in range(20)][-1], (net, other)))
    assert_same(both[0], expected)
    net.double()
    assert_same(quickly(net, data=images().double()), slowly(net, data=images().double()))


def test_inference_mode_and_no_grad_can_alternate(net_of: Callable[..., Net]) -> None:
    lrn = 'layer { name: "lrn" type: "LRN" bottom: "scale" top: "lrn" }'
    net = trained(net_of(BLOCK + lrn))
    expected = slowly(net, data=images())
    for mode in (torch.inference_mode, torch.no_grad, torch.inference_mode):
        with mode():
            assert_same(net(data=images()), expected)


def test_layers_that_share_weights_pack_them_separately(net_of: Callable[..., Net]) -> None:
    text = 'layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 8 dim: 300 } } }'
    for name, bottom, transposed in (("in", "data", "false"), ("out", "in", "true"), ("again", "out", "false")):
        text += f"""
layer {{ name: "{name}" type: "InnerProduct" bottom: "{bottom}" top: "{name}" param {{ name: "w" }}
  inner_product_param {{ num_output: 300 transpose: {transposed} bias_term: false
    weight_filler {{ type: "xavier" }} }} }}
"""
    net, x = net_of(text, exact="none"), torch.randn(8, 300)
    assert_same(quickly(net, data=x), slowly(net, data=x))
    assert last_sequence(net).kinds == ["packed"] * 3


@pytest.mark.parametrize("exact", ["none", "small", "all"])
@pytest.mark.parametrize("items", [3, 300])
def test_layers_that_share_weights_by_count_keep_a_copy_for_each_shape(
    net_of: Callable[..., Net], exact: str, items: int
) -> None:
    """With share_mode: PERMISSIVE, one blob is a matrix (4, 7), its transpose (7, 4), and filters (28, 1, 1, 1)."""
    text = f"""
layer {{ name: "x" type: "Input" top: "x" input_param {{ shape {{ dim: {items} dim: 7 }} }} }}
layer {{ name: "a" type: "InnerProduct" bottom: "x" top: "a" param {{ name: "w" }}
  inner_product_param {{ num_output: 4 bias_term: false weight_filler {{ type: "xavier" }} }} }}
layer {{ name: "b" type: "InnerProduct" bottom: "x" top: "b" param {{ name: "w" share_mode: PERMISSIVE }}
  inner_product_param {{ num_output: 4 bias_term: false transpose: true }} }}
layer {{ name: "r" type: "Reshape" bottom: "x" top: "r" reshape_param {{ shape: {{ dim: 0 dim: 1 dim: 7 dim: 1 }} }} }}
layer {{ name: "c" type: "Convolution" bottom: "r" top: "c" param {{ name: "w" share_mode: PERMISSIVE }}
  convolution_param {{ num_output: 28 kernel_size: 1 bias_term: false }} }}
"""
    net, x = net_of(text, exact=exact), torch.randn(items, 7)
    w = net.params["a"][0].detach().clone()
    found = quickly(net, x=x)
    assert_same(found, slowly(net, x=x))
    expected = {"a": x @ w.T, "b": x @ w.view(7, 4), "c": x[:, None, :, None] * w.view(28, 1, 1)}
    for name, values in expected.items():
        torch.testing.assert_close(found[name], values)


@pytest.mark.parametrize(
    ("loss", "bottoms", "expected"),
    [
        ("EuclideanLoss", "x y", 24 / 4),
        ("HingeLoss", "x label", 6),
        ("MultinomialLogisticLoss", "x label", -np.log(2)),
        ("SigmoidCrossEntropyLoss", "x y", 3 * (np.log1p(np.exp(-2)) - 6)),
        ("ContrastiveLoss", "x y label", 0),
        ("SoftmaxWithLoss", "x label", np.log(3)),
    ],
)
@pytest.mark.parametrize("exact", ["none", "all"])
def test_a_loss_without_a_top_counts(
    net_of: Callable[..., Net], loss: str, bottoms: str, expected: float, exact: str
) -> None:
    """Caffe gives it an automatic top with loss_weight 1. The bottoms have rows of 2s and of 4s; labels are 0."""
    text = f"""
layer {{ name: "d" type: "DummyData" top: "x" top: "y" top: "label" dummy_data_param {{
  shape {{ dim: 2 dim: 3 }} shape {{ dim: 2 dim: 3 }} shape {{ dim: 2 }}
  data_filler {{ value: 2 }} data_filler {{ value: 4 }} data_filler {{ value: 0 }} }} }}
layer {{ name: "quiet" type: "Silence" {" ".join(f'bottom: "{b}"' for b in ("x", "y", "label"))} }}
layer {{ name: "loss" type: "{loss}" {" ".join(f'bottom: "{b}"' for b in bottoms.split())} }}
"""
    net = net_of(text, exact=exact)
    with torch.no_grad():
        quick = net.forward_loss()[0].item()
    assert quick == net.forward_loss()[0].item()
    named = net_of(text.replace(f'type: "{loss}"', f'type: "{loss}" top: "loss"'), exact=exact)
    assert quick == named()["loss"].item()
    assert quick == pytest.approx(expected, abs=1e-6)


def test_a_subclass_with_its_own_forward_inherits_no_kernels() -> None:
    class Halved(Convolution):
        @override
        def forward(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
            return tuple(top / 2 for top in super().forward(*bottoms))

    class Named(Convolution):
        """The same forward pass."""

    class Doubled(Sigmoid):
        @override
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return 2 * super().forward(x)

    def made(cls: type[Layer]) -> Layer:
        param = LayerParameter(name="it", type="Convolution", bottom=["x"], top=["y"])
        param.convolution_param.num_output = 2
        param.convolution_param.kernel_size.append(3)
        return cls(param, [(1, 2, 4, 4)])

    assert exporter_of(made(Named))
    for other in (Halved, Doubled):
        with pytest.raises(SpecError, match="cannot be exported"):
            exporter_of(made(other))
    assert entry_of(made(Halved)) == entry_of(made(Named)) == Entry()  # entries are those of one class


@pytest.mark.parametrize(("low", "high", "steps"), [(0, 6, 1), (-1, 0.5, 1), (2, 1, 2)])
def test_clip_is_fused_into_the_layer_before_it(net_of, low: float, high: float, steps: int) -> None:
    text = f"""
layer {{ name: "data" type: "Input" top: "data" input_param {{ shape {{ dim: 2 dim: 8 dim: 20 dim: 20 }} }} }}
layer {{ name: "c" type: "Convolution" bottom: "data" top: "c"
  convolution_param {{ num_output: 32 kernel_size: 3 weight_filler {{ type: "gaussian" std: 1 }} }} }}
layer {{ name: "clip" type: "Clip" bottom: "c" top: "c" clip_param {{ min: {low} max: {high} }} }}
"""
    net, x = net_of(text, exact="none"), torch.randn(2, 8, 20, 20)
    assert_same(quickly(net, data=x), slowly(net, data=x))
    assert len(last_sequence(net).steps) == steps

"""Gradients of parameters are returned to autograd or added to ``grad`` at once, as the net was built."""

from pathlib import Path

import numpy as np
import pytest
import torch

SIAMESE = (Path(__file__).parent / "nets" / "siamese.prototxt").read_text()


def images() -> dict[str, torch.Tensor]:
    return {name: torch.randn(2, 1, 4, 4) for name in "ab"}


@pytest.mark.parametrize("exact", ["none", "small", "all"])
@pytest.mark.parametrize("in_place", [False, True])
def test_passes_add_up_in_grad(net_of, exact: str, in_place: bool) -> None:
    inputs = images()
    plain = net_of(SIAMESE, phase=0, exact=exact)
    expected = torch.autograd.grad(plain.forward_loss(**inputs)[0], [item.parameter for item in plain.learnable])
    net = net_of(SIAMESE, phase=0, exact=exact, accumulate_in_place=in_place)
    for passes in (1, 2):
        net.forward_loss(**inputs)[0].backward()
        for item, one in zip(net.learnable, expected, strict=True):
            torch.testing.assert_close(item.parameter.grad, passes * one)


@pytest.mark.parametrize("exact", ["none", "small", "all"])
def test_a_net_shows_its_gradients_to_hooks_and_to_autograd(net_of, exact: str) -> None:
    net, inputs = net_of(SIAMESE, phase=0, exact=exact), images()
    parameters = [item.parameter for item in net.learnable]
    gradients = torch.autograd.grad(net.forward_loss(**inputs)[0], parameters)
    assert all(parameter.grad is None for parameter in parameters)
    seen: list[torch.Tensor] = []
    for parameter in parameters:
        parameter.register_hook(lambda gradient: seen.append(gradient.clone()))
    net.forward_loss(**inputs)[0].backward()
    total = sum(float(gradient.sum()) for gradient in gradients)
    np.testing.assert_allclose(sum(float(gradient.sum()) for gradient in seen), total, rtol=1e-4)


def test_a_net_trains_side_by_side_as_torchs_wrappers_have_it(net_of, tmp_path) -> None:
    net, inputs = net_of(SIAMESE, phase=0), images()
    torch.distributed.init_process_group("gloo", init_method=f"file://{tmp_path / 'store'}", rank=0, world_size=1)
    try:
        wrapped = torch.nn.parallel.DistributedDataParallel(net)
        wrapped(**inputs)["loss"].backward()
    finally:
        torch.distributed.destroy_process_group()
    expected = net_of(SIAMESE, phase=0)
    expected.forward_loss(**inputs)[0].backward()
    for mine, theirs in zip(net.learnable, expected.learnable, strict=True):
        torch.testing.assert_close(mine.parameter.grad, theirs.parameter.grad)


@pytest.mark.parametrize("exact", ["none", "small", "all"])
def test_gradients_added_in_place_are_not_returned_to_autograd(net_of, exact: str) -> None:
    """What one asks for when one builds so."""
    net = net_of(SIAMESE, phase=0, exact=exact, accumulate_in_place=True)
    parameters = [item.parameter for item in net.learnable]
    gradients = torch.autograd.grad(net.forward_loss(**images())[0], parameters, allow_unused=True)
    assert gradients == (None,) * 4
    assert all(parameter.grad is not None for parameter in parameters)


@pytest.mark.parametrize("exact", ["none", "small", "all"])
def test_no_gradient_of_a_tower_waits_for_the_other_tower(net_of, exact: str) -> None:
    """Autograd would hold those of the first tower, as large as the weights, until the second has its own."""
    net = net_of(SIAMESE, phase=0, exact=exact, accumulate_in_place=True)
    net.keep = "all"
    loss, _ = net.forward_loss(**images())
    of_one: list[torch.Tensor] = []
    net.blobs["ip"].register_hook(lambda _: of_one.extend(item.parameter.grad.clone() for item in net.learnable))
    loss.backward()  # begins with the tower that ran last
    for item, before in zip(net.learnable, of_one, strict=True):
        assert before.any(), item.layer
        assert not torch.equal(before, item.parameter.grad), item.layer


@pytest.mark.parametrize("in_place", [False, True])
def test_frozen_parameters_get_no_gradient(net_of, in_place: bool) -> None:
    text = SIAMESE.replace('"w" }', '"w" lr_mult: 0 }').replace('"y" }', '"y" lr_mult: 0 }')
    net = net_of(text, phase=0, accumulate_in_place=in_place)
    net.forward_loss(**images())[0].backward()
    assert [item.parameter.grad is None for item in net.learnable] == [True, False, False, True]


@pytest.mark.parametrize("transposed", ["false", "true"])
@pytest.mark.parametrize("exact", ["none", "small"])
def test_an_inner_product_adds_its_gradient_to_existing_memory(net_of, transposed: str, exact: str) -> None:
    """No tensor as large as the weights is made in a pass, be the product small or too large to be exact."""
    text = f"""
        layer {{ name: "data" type: "Input" top: "data" input_param {{ shape {{ dim: 2 dim: 600 }} }} }}
        layer {{ name: "ip" type: "InnerProduct" bottom: "data" top: "ip" inner_product_param {{ num_output: 900
                transpose: {transposed} weight_filler {{ type: "gaussian" }} }} }}
        layer {{ name: "loss" type: "Reduction" bottom: "ip" top: "loss" loss_weight: 1
                reduction_param {{ operation: SUMSQ }} }}"""
    net = net_of(text, phase=0, exact=exact, accumulate_in_place=True)
    data = torch.randn(2, 600)
    net.forward_loss(data=data)[0].backward()
    one = net.params["ip"][0].grad.clone()
    with torch.profiler.profile(profile_memory=True) as profile:
        net.forward_loss(data=data)[0].backward()
    torch.testing.assert_close(net.params["ip"][0].grad, 2 * one)
    events = profile.events()
    assert events
    assert max(event.self_cpu_memory_usage for event in events) < 600 * 900 * 4
    reference = net_of(text, phase=0, exact="none")
    reference.forward_loss(data=data)[0].backward()
    torch.testing.assert_close(one, reference.params["ip"][0].grad)


def test_gradients_in_bf16_are_those_of_float32_up_to_rounding(net_of) -> None:
    net, inputs = net_of(SIAMESE, phase=0, exact="none", accumulate_in_place=True), images()
    for _ in range(2):
        with torch.autocast("cpu", torch.bfloat16):
            loss, _ = net.forward_loss(**inputs)
        loss.backward()
    expected = net_of(SIAMESE, phase=0, exact="none")
    expected.forward_loss(**inputs)[0].backward()
    for mine, theirs in zip(net.learnable, expected.learnable, strict=True):
        assert mine.parameter.grad.dtype == torch.float32
        atol = 0.03 * float(theirs.parameter.grad.abs().max())
        torch.testing.assert_close(mine.parameter.grad / 2, theirs.parameter.grad, rtol=0, atol=atol)

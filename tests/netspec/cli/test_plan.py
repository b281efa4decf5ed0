"""``netspec check --plan`` and ``--passes``."""

from collections.abc import Callable
from typing import Any

import pytest

from paths import ROOT

DEPLOY = ROOT / "prototxt" / "small" / "siamese_resnet27_256" / "deploy.prototxt"


@pytest.mark.slow
def test_the_plan_shows_joined_layers(run: Callable[..., Any]) -> None:
    lines = run("check", DEPLOY, "--plan").out.splitlines()
    (first,) = (line for line in lines if line.startswith("  ") and line.split()[1] == "conv1a")
    assert first.split(maxsplit=1)[1] == "conv1a + bn_conv1a + scale_conv1a + relu_conv1a"
    assert any("passes: fold, fuse, skip, pack; bfloat16 on this CPU:" in line for line in lines)


@pytest.mark.slow
@pytest.mark.parametrize(("passes", "steps"), [("skip", 127), ("none", None)])
def test_passes_are_switched(run: Callable[..., Any], passes: str, steps: int | None) -> None:
    out = run("check", DEPLOY, "--plan", "--passes", passes).out
    assert (f"run as {steps} steps" in out) if steps else "no passes" in out


def test_an_unknown_pass_is_refused(run: Callable[..., Any]) -> None:
    result = run("check", DEPLOY, "--passes", "folds")
    assert result.status == 2
    assert "found 'folds', expected none, or some of fold,fuse,skip,pack" in result.err


@pytest.mark.slow
def test_the_plan_shows_how_a_net_is_trained(run: Callable[..., Any]) -> None:
    folder = DEPLOY.parents[1]
    shape = ("--shape", "pair_data=2,6,64,64")
    for name, said in (("siamese_8", "by kernels prepared once"), ("siamese_resnet27_256", "by kernels prepared once")):
        net = folder / name / "train_val.prototxt"
        assert said in run("check", net, "--plan", "--phase", "TRAIN", *shape).out
    large = ("--shape", "pair_data=8,6,224,224")
    assert "more than 4,194,304" in run("check", net, "--plan", "--phase", "TRAIN", *large).out

"""What forks themselves computed: ENet's and SegNet's layers, the layers that read text, and a training with each.

tests/golden/forks/README.md says which forks, and how they were built. Their oddities are repeated: the gradient of
CTC is that of the sum over sequences, though the loss is their mean (ctc*), a text that does not fit costs 0
(ctc_does_not_fit), and a weighted loss is divided by the number of labels, not by their weights (segnet_softmax_*).
"""

import shutil
from pathlib import Path

import numpy as np
import pytest

import netspec
from golden_cases import LayerCase, assert_same_layers, parameters, train
from netspec.dialects import use_dialects_of
from paths import GOLDEN

FORKS = GOLDEN / "forks"
CASES = sorted((FORKS / "layers").iterdir())


@pytest.mark.parametrize("folder", CASES, ids=lambda path: path.name)
def test_a_layer_computes_what_the_fork_computed(folder: Path) -> None:
    use_dialects_of((folder / "net.prototxt").read_text(), str(folder))
    case = LayerCase(folder)
    found = case.compute()
    expected = {key for key in case.golden if key.startswith(("out/", "indiff/", "paramdiff/"))}
    assert expected <= set(found)
    for key, value in found.items():
        scale = max(float(np.abs(case.golden[key]).max(initial=0)), 1e-30)
        assert value.shape == case.golden[key].shape, key
        assert float(np.abs(value - case.golden[key]).max(initial=0)) <= 1e-5 * scale, key


@pytest.mark.slow
@pytest.mark.parametrize("name", ["enet", "crnn"])
def test_a_training_follows_the_fork(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(FORKS / "training" / name, tmp_path / name)
    monkeypatch.chdir(tmp_path / name)
    golden = np.load("trajectory.npz")
    use_dialects_of(Path("train.prototxt").read_text(), "train.prototxt")
    solver = netspec.load_solver("solver.prototxt", weights="init.caffemodel")
    losses = np.array(train(solver, 30))
    np.testing.assert_allclose(losses, golden["loss"], rtol=2e-5)
    assert_same_layers(parameters(solver.net, golden, "final/"), golden, 2e-5)

"""caffe.SGDSolver and the others: what Caffe's test_solver.py checks, and loops as scripts have them."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

import netspec
import netspec.pycaffe as caffe
from benchmarks.case import training_case
from benchmarks.zoo import ZOO
from netspec.compat.pycaffe import mode
from pycaffe_nets import CLASSES, SMALL

SETTINGS = (Path(__file__).parent / "nets" / "settings.prototxt").read_text()
MEMORY = (Path(__file__).parent / "nets" / "memory.prototxt").read_text()


@pytest.fixture
def solver(write: Callable[..., str]) -> caffe.SGDSolver:
    write(SMALL)
    solver = caffe.SGDSolver(write(SETTINGS, "solver.prototxt"))
    labels = np.random.default_rng(0).integers(CLASSES, size=4)
    for net in (solver.net, solver.test_nets[0]):
        net.blobs["label"].data[...] = labels
    return solver


@pytest.mark.slow
def test_solve(solver: caffe.SGDSolver) -> None:
    assert solver.iter == 0
    solver.solve()
    assert solver.iter == 100


def test_apply_update(solver: caffe.SGDSolver) -> None:
    weights = solver.net.layers[1].blobs[0].data
    weights[...] = 0
    solver.net.layers[1].blobs[0].diff[...] = 1
    assert solver.lr == pytest.approx(0.01)
    solver.apply_update()
    np.testing.assert_allclose(weights, -0.01, atol=1e-7)
    solver.increment_iter()
    solver.apply_update()
    assert solver.iter == 2


def test_nets_outlive_the_solver(solver: caffe.SGDSolver) -> None:
    nets = [solver.net, *solver.test_nets]
    assert len(nets) == 2
    del solver
    for net in nets:
        net.forward()
        blobs = [blob for blobs in net.params.values() for blob in blobs] + list(net.blobs.values())
        assert np.isfinite(sum(blob.data.sum() + blob.diff.sum() for blob in blobs))


def test_snapshot_and_restore(solver: caffe.SGDSolver) -> None:
    solver.step(3)
    solver.snapshot()
    assert Path("model_iter_3.caffemodel").exists()
    assert Path("model_iter_3.solverstate").exists()
    weights = solver.net.params["filters"][0].data.copy()
    solver.step(2)
    solver.restore("model_iter_3.solverstate")
    assert solver.iter == 3
    assert (solver.net.params["filters"][0].data == weights).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SGD", "Nesterov", "AdaGrad", "RMSProp", "AdaDelta", "Adam"])
def test_six_solvers(name: str, write: Callable[..., str]) -> None:
    write(SMALL)
    settings = SETTINGS if name in ("SGD", "Nesterov", "Adam", "AdaDelta") else SETTINGS.replace("momentum: 0.9", "")
    plain = write(settings, "solver.prototxt")
    solver = getattr(caffe, f"{name}Solver")(plain)
    assert solver.param.type == name
    named = caffe.get_solver(write(f'{settings} type: "{name}"', "typed.prototxt"))
    assert type(named) is type(solver)
    solver.step(1)
    assert solver.iter == 1


def test_diffs_hold_the_update_and_views_stay_valid(solver: caffe.SGDSolver) -> None:
    blob = solver.net.params["scores"][0]
    weights, diff = blob.data, blob.diff
    for _ in range(3):
        before = weights.copy()
        solver.step(1)
        assert np.abs(diff).max() > 0
        np.testing.assert_allclose(before - diff, weights, atol=1e-7)
        assert np.shares_memory(diff, blob.diff)


def test_blobs_show_each_iteration(solver: caffe.SGDSolver) -> None:
    seen = []
    kept = solver.net.blobs["cost"].data
    for _ in range(5):
        solver.step(1)
        assert kept == solver.net.blobs["cost"].data
        seen.append(float(kept))
        assert solver.net.blobs["maps"].diff.any()
    assert len(set(seen)) == 5


@pytest.mark.parametrize("net", [SMALL, MEMORY], ids=["constant labels", "data in memory"])
def test_several_steps_equal_single_steps(net: str, write: Callable[..., str]) -> None:
    """Within a call only the last pass fills the blobs, unless code can read them, or has written to one."""
    write(net)
    rng = np.random.default_rng(0)
    data, labels = rng.random((12, 2, 6, 6), np.float32), rng.integers(5, size=12).astype(np.float32)
    settings = SETTINGS.replace("test_iter: 10 test_interval: 10", "") + " random_seed: 3"
    found, seen = [], []
    for steps in ([1] * 7, [2, 5], [7], [7]):
        solver = caffe.SGDSolver(write(settings, "solver.prototxt"))
        if net == MEMORY:
            solver.net.set_input_arrays(data, labels)
        else:
            solver.net.blobs["label"].data[...] = [1, 2, 3, 0]
        if len(found) == 3:
            loss = solver.net.blobs[solver.net.outputs[0]]
            solver.add_callback(lambda: None, lambda loss=loss: seen.append(loss.data.item()))
        for count in steps:
            solver.step(count)
        blobs = [*solver.net.blobs.values(), *(blob for blobs in solver.net.params.values() for blob in blobs)]
        found.append([array.copy() for blob in blobs for array in (blob.data, blob.diff)])
    for arrays in found[1:]:
        assert [np.array_equal(a, b) for a, b in zip(arrays, found[0], strict=True)] == [True] * len(arrays)
    assert len(set(seen)) == 7


def test_test_nets_share_the_weights_from_the_first_test_on(solver: caffe.SGDSolver) -> None:
    mine, theirs = solver.net.params["scores"][0], solver.test_nets[0].params["scores"][0]
    assert not np.array_equal(mine.data, theirs.data)
    solver.step(2)  # tests at iteration 0
    assert np.array_equal(mine.data, theirs.data)
    score = solver.test_nets[0].forward()["cost"]
    assert score.shape == ()
    other = caffe.Net("net.prototxt", caffe.TEST)
    solver.share_weights(other)
    assert np.shares_memory(other.params["scores"][0].data, mine.data)


def test_settings_can_be_changed(solver: caffe.SGDSolver) -> None:
    assert (solver.param.max_iter, solver.param.display) == (100, 100)
    solver.param.base_lr = 0
    weights = solver.net.params["scores"][0].data
    before = weights.copy()
    solver.step(1)
    assert (weights == before).all()


def test_callbacks(solver: caffe.SGDSolver) -> None:
    reported = []
    weights = solver.net.params["scores"][0].data
    before = weights.copy()
    solver.add_callback(
        lambda: reported.append("start"),
        lambda: reported.append(("ready", solver.iter, bool((weights == before).all()))),
    )
    solver.step(1)
    assert reported == ["start", ("ready", 0, True)]
    assert not (weights == before).all()


def test_inputs_of_a_training_net_are_written_by_the_script(write: Callable[..., str]) -> None:
    write("""
    input: "data" input_shape { dim: 8 dim: 2 } input: "wanted" input_shape { dim: 8 dim: 1 }
    layer { name: "fc" type: "InnerProduct" bottom: "data" top: "fc" inner_product_param { num_output: 1 } }
    layer { name: "loss" type: "EuclideanLoss" bottom: "fc" bottom: "wanted" top: "loss" }
    """)
    solver = caffe.get_solver(write('net: "net.prototxt" base_lr: 0.5 lr_policy: "fixed"', "solver.prototxt"))
    solver.net.blobs["data"].reshape(16, 2)
    solver.net.blobs["wanted"].reshape(16, 1)
    random = np.random.default_rng(0)
    for _ in range(200):
        data = random.standard_normal((16, 2))
        solver.net.blobs["data"].data[...] = data
        solver.net.blobs["wanted"].data[...] = data @ [[3], [-2]] + 1
        solver.step(1)
    np.testing.assert_allclose(solver.net.params["fc"][0].data, [[3, -2]], atol=1e-3)
    np.testing.assert_allclose(solver.net.params["fc"][1].data, [1], atol=1e-3)


def test_errors_in_files_are_exceptions(write: Callable[..., str]) -> None:
    write(SMALL)
    with pytest.raises(ValueError, match=r'solver.prototxt:\d+:\d+: unknown lr_policy "fxed"'):
        caffe.SGDSolver(write('net: "net.prototxt" base_lr: 0.01 lr_policy: "fxed"', "solver.prototxt"))
    with pytest.raises(ValueError, match=r'unknown solver type "Sgd2"'):
        caffe.get_solver(write('net: "net.prototxt" type: "Sgd2" lr_policy: "fixed"', "solver.prototxt"))


def test_debug_info_equals_that_of_netspecs_solver(write: Callable[..., str], caplog: pytest.LogCaptureFixture) -> None:
    write(SMALL.replace("force_backward: true", ""))
    settings = write(
        'net: "net.prototxt" base_lr: 0.1 lr_policy: "fixed" debug_info: true display: 1 random_seed: 1', "s.prototxt"
    )
    caplog.set_level("INFO")
    logs = []
    for solver in (caffe.SGDSolver(settings), netspec.load_solver(settings)):
        caplog.clear()
        solver.step(1)
        logs.append([m for m in caplog.messages if "ward]" in m])
    assert logs[0] == logs[1]
    assert len(logs[0]) > 10


@pytest.mark.slow
@pytest.mark.parametrize("case", ["sgd_step", "sgd_iter_size", "adam", "tiny", "lenet", "cifar10_quick", "pnet"])
def test_the_weights_are_those_of_netspecs_solver(
    case: str, work_in: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit by bit if everything is computed in Caffe's order. What a script writes counts."""
    monkeypatch.setattr(mode, "exact", lambda: "all")
    with ExitStack() as stack:
        if case in ZOO:
            made = stack.enter_context(training_case(case, 3))
            file, weights = made.solver, made.caffemodel
        else:
            work_in(f"train/{case}")
            file, weights = f"{case}/solver.prototxt", f"{case}/init.caffemodel"
        solver, core = caffe.get_solver(file), netspec.load_solver(file, weights=weights, exact="all")
        solver.net.copy_from(weights)
        for steps in (1, 2):
            solver.step(steps)
            core.step(steps)
            for mine, parameters in zip(solver.net.params.values(), core.net.params.values(), strict=True):
                for blob, parameter in zip(mine, parameters, strict=True):
                    np.testing.assert_array_equal(blob.data, parameter.detach().numpy())
                    blob.data[...] *= 0.5
                    parameter.data.mul_(0.5)

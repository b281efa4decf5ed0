import logging
import signal
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from typing_extensions import override

from case_files import read_cases
from golden_cases import Losses, train
from netspec.errors import SpecError
from netspec.files.whole_file import only_one
from netspec.load import load_solver
from netspec.proto.schema import NetParameter
from netspec.solver import update
from netspec.solver.snapshot import read_state
from netspec.solver.solver import Solver
from netspec.solver.training import Callback

NET = """
name: "tiny"
layer { name: "data" type: "DummyData" top: "data" top: "label" dummy_data_param {
  shape { dim: 4 dim: 3 } shape { dim: 4 dim: 2 } data_filler { type: "gaussian" std: 1 } data_filler { value: 1 } } }
layer { name: "ip" type: "InnerProduct" bottom: "data" top: "ip" param { lr_mult: 1 } param { lr_mult: 2 }
  inner_product_param { num_output: 2 weight_filler { type: "gaussian" std: 1 } } }
layer { name: "loss" type: "EuclideanLoss" bottom: "ip" bottom: "label" top: "loss" }
"""
SETTINGS = 'net: "net.prototxt"\nbase_lr: 0.1\nlr_policy: "fixed"\nsolver_mode: CPU\nrandom_seed: 3\n'


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Solver]:
    """Return a function that makes a solver of the tiny net, with more settings."""
    monkeypatch.chdir(tmp_path)
    Path("net.prototxt").write_text(NET)

    def solver_of(more: str = "", settings: str = SETTINGS, net: str = NET, **arguments) -> Solver:
        Path("net.prototxt").write_text(net)
        Path("s.prototxt").write_text(settings + more)
        return load_solver("s.prototxt", **arguments)

    return solver_of


def weights(solver: Solver) -> list[torch.Tensor]:
    return [item.parameter.detach().clone() for item in solver.net.learnable]


def test_setting_an_attribute_that_nothing_reads_is_refused(make: Callable[..., Solver]) -> None:
    solver = make()
    with pytest.raises(AttributeError, match="a Solver has no base_lr; its settings are in param"):
        solver.base_lr = 0.5
    solver.param.base_lr = 0.5
    assert solver.learning_rate == 0.5


# When it tests


def seen_tests(solver: Solver, run: Callable[[], None]) -> list[tuple[int, int]]:
    """The (iteration, test net) of each test of a run."""
    found: list[tuple[int, int]] = []

    class Seen(Callback):
        @override
        def on_test(self, net: int) -> None:
            found.append((solver.iteration, net))

    solver.callbacks.append(Seen())
    run()
    return found


def test_tests_run_before_the_update_and_at_the_end(make):
    solver = make("test_iter: 1 test_iter: 1 test_interval: 2 max_iter: 4 snapshot_after_train: false")
    assert seen_tests(solver, solver.solve) == [(0, 0), (0, 1), (2, 0), (2, 1), (4, 0), (4, 1)]


def test_without_test_initialization_the_first_test_is_later(make):
    solver = make("test_iter: 1 test_interval: 2 max_iter: 3 test_initialization: false snapshot_after_train: false")
    assert seen_tests(solver, solver.solve) == [(2, 0)]


def test_a_test_is_the_mean_over_its_batches_with_the_current_weights(make):
    solver = make("test_iter: 3 test_interval: 5", net=NET.replace('type: "gaussian" std: 1 } data', "value: 2 } data"))
    solver.step(1)
    before = solver.scores
    assert list(before[0]) == ["loss"]
    solver.test_all()
    with torch.no_grad():
        assert solver.scores[0]["loss"] == pytest.approx([solver.net.forward_loss()[0].item()], rel=1e-5)
    assert solver.scores[0]["loss"][0] < before[0]["loss"][0]


def test_test_compute_loss_prints_the_mean_loss(make, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.INFO, "netspec"):
        solver = make("test_iter: 2 test_interval: 5 test_compute_loss: true")
        solver.test_all()
    shown = [record.getMessage() for record in caplog.records if record.getMessage().startswith("Test loss: ")]
    assert [float(line.split()[-1]) for line in shown] == pytest.approx(solver.scores[0]["loss"], rel=1e-4)


# What it calls


def test_callbacks_are_called_in_order(make) -> None:
    """In their order, each at its time; ``iteration`` counts an update before ``on_iteration``."""
    called: list[tuple[str, str, int]] = []
    solver = make("snapshot: 2 test_iter: 1 test_interval: 2")

    class Noted(Callback):
        def __init__(self, name: str) -> None:
            for method in ("on_start", "on_gradients_ready", "on_iteration", "on_test", "on_snapshot"):
                note = lambda *_, at=method: called.append((name, at, solver.iteration))  # noqa: E731
                setattr(self, method, note)

    solver.callbacks += [Noted("first"), Noted("second")]
    solver.step(2)
    expected = [("on_test", 0)]
    expected += [("on_start", 0), ("on_gradients_ready", 0), ("on_iteration", 1)]
    expected += [("on_start", 1), ("on_gradients_ready", 1), ("on_iteration", 2), ("on_snapshot", 2)]
    assert called == [(name, at, count) for at, count in expected for name in ("first", "second")]


# What the loss is


def test_the_averaged_loss_restarts_with_each_step(make):
    solver = make("average_loss: 2", net=NET.replace('type: "gaussian" std: 1 } data', "value: 2 } data"))
    single = make("", net=NET.replace('type: "gaussian" std: 1 } data', "value: 2 } data"))
    raw = train(single, 5)
    shown = Losses(solver).found
    solver.step(3)
    solver.step(2)
    assert shown == pytest.approx([raw[0], (raw[0] + raw[1]) / 2, (raw[1] + raw[2]) / 2, raw[3], (raw[3] + raw[4]) / 2])


def test_a_net_without_layers_trains_nothing(make):
    solver = make(net='name: "n"')
    solver.step(2)
    assert (solver.iteration, solver.loss) == (2, 0)


def test_the_first_layer_of_a_name_is_shared_with_a_test_net(make):
    layer = 'layer { name: "ip" type: "InnerProduct" bottom: "%s" top: "%s" include { phase: TEST } %s }'
    product = "inner_product_param { num_output: 3 weight_filler { value: 2 } }"
    net = NET.replace("num_output: 2", "num_output: 3").replace("dim: 4 dim: 2", "dim: 4 dim: 3")
    solver = make(net=net + layer % ("ip", "second", product), more="test_iter: 1 test_interval: 5\n")
    solver.step(1)
    first, second = (layer.blob(0) for layer in solver.test_nets[0].layers if layer.type == "InnerProduct")
    assert first is solver.net.params["ip"][0]
    assert second.unique().tolist() == [2]


# What moves


def test_a_parameter_with_rate_0_ignores_weight_decay(make):
    solver = make("weight_decay: 0.5 momentum: 0.9", net=NET.replace("lr_mult: 2", "lr_mult: 0 decay_mult: 1"))
    solver.net.params["ip"][1].data.fill_(1)
    before = weights(solver)
    solver.step(3)
    after = weights(solver)
    assert not torch.equal(before[0], after[0])
    assert torch.equal(before[1], after[1])


def test_after_a_step_the_gradients_are_the_subtracted_values(make):
    solver = make("momentum: 0.9 snapshot_diff: true")
    solver.step(1)
    before = weights(solver)
    solver.step(1)
    for old, item in zip(before, solver.net.learnable, strict=True):
        torch.testing.assert_close(old - item.parameter.detach(), item.parameter.grad)
    model, _ = solver.snapshot()
    layer = NetParameter.FromString(Path(model).read_bytes()).layer[1]
    grad = solver.net.params["ip"][0].grad
    assert grad is not None
    np.testing.assert_array_equal(np.array(layer.blobs[0].diff, np.float32), grad.numpy().ravel())


@pytest.mark.parametrize("exact", ["none", "small"])
def test_gradients_keep_their_memory(make, exact):
    """Fresh memory for the gradients of 70 million weights takes longer to get than the gradients themselves."""
    solver = make(exact=exact)
    solver.step(1)
    first = [item.parameter.grad for item in solver.net.learnable]
    solver.step(2)
    assert all(item.parameter.grad is grad for item, grad in zip(solver.net.learnable, first, strict=True))


def test_the_seed_decides_everything(make):
    first, second, third = make(), make(), make(settings=SETTINGS.replace("seed: 3", "seed: 4"))
    for solver in (first, second, third):
        solver.step(3)
    assert torch.equal(weights(first)[0], weights(second)[0])
    assert not torch.equal(weights(first)[0], weights(third)[0])


def test_the_learning_rate_is_that_of_the_next_iteration(make):
    settings = SETTINGS.replace('"fixed"', '"step" stepsize: 2 gamma: 0.5')
    solver = make(settings=settings)
    rates = []
    for _ in range(4):
        rates.append(solver.learning_rate)
        solver.step(1)
    assert rates == pytest.approx([0.1, 0.1, 0.05, 0.05])


# Snapshots and requests


def files() -> list[str]:
    """Caffe's snapshots; beside each state lies what Caffe forgets."""
    found = sorted(path.name for path in Path().glob("*_iter_*"))
    caffes = [name for name in found if not name.endswith(".extra")]
    assert [f"{name}.extra" for name in caffes if "solverstate" in name] == sorted(set(found) - set(caffes))
    return caffes


def test_snapshots_are_taken_at_their_interval_and_after_training(make):
    solver = make("snapshot: 2 max_iter: 5")
    solver.solve()
    assert files() == [f"s_iter_{n}.{kind}" for n in (2, 4, 5) for kind in ("caffemodel", "solverstate")]
    assert read_state("s_iter_4.solverstate").iteration == 4
    assert read_state("s_iter_4.solverstate").learned_net == "s_iter_4.caffemodel"


def test_the_last_iteration_has_one_snapshot(make, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.INFO, "netspec"):
        make('snapshot: 2 max_iter: 4 snapshot_format: HDF5 snapshot_prefix: "p"').solve()
    assert files() == [f"p_iter_{n}.{kind}.h5" for n in (2, 4) for kind in ("caffemodel", "solverstate")]
    assert caplog.text.count("Snapshotting to HDF5 file p_iter_4.caffemodel.h5") == 1


def test_snapshot_after_train_can_be_turned_off(make):
    make("max_iter: 1 snapshot_after_train: false").solve()
    assert files() == []


def test_a_stop_takes_effect_after_the_iteration_with_a_snapshot(make, caplog: pytest.LogCaptureFixture):
    asked = iter([None, "snapshot", "stop"])
    solver = make("max_iter: 9 test_iter: 1 test_interval: 100 test_initialization: false", action=lambda: next(asked))
    with caplog.at_level(logging.INFO, "netspec"):
        solver.solve()
    assert solver.iteration == 3
    assert solver.stopped
    assert files() == [f"s_iter_{n}.{kind}" for n in (2, 3) for kind in ("caffemodel", "solverstate")]
    assert "Optimization stopped early." in caplog.text
    assert "Optimization Done." not in caplog.text


def test_a_stop_takes_effect_within_a_test(make, caplog: pytest.LogCaptureFixture):
    asked = iter([None, "snapshot", "stop", None])
    solver = make("max_iter: 9 test_iter: 5 test_interval: 3", action=lambda: next(asked))
    with caplog.at_level(logging.INFO, "netspec"):
        solver.step(9)
    assert solver.iteration == 0
    assert solver.stopped
    assert files() == ["s_iter_0.caffemodel", "s_iter_0.solverstate"]
    assert "Test interrupted." in caplog.text


def test_training_can_continue_after_a_stop(make):
    asked = iter(["stop"])
    solver = make("max_iter: 3 snapshot_after_train: false", action=lambda: next(asked, None))
    solver.solve()
    assert (solver.iteration, solver.stopped) == (1, True)
    solver.solve()
    assert (solver.iteration, solver.stopped) == (3, False)


# Weights to start from


def test_weights_and_a_snapshot_exclude_each_other(make):
    with pytest.raises(SpecError, match="not both"):
        make(weights="a.caffemodel", snapshot="a.solverstate")


# What is refused before the first iteration


FAULTS = read_cases("netspec/solver/cases/settings.txt")


@pytest.mark.parametrize("case", FAULTS.values(), ids=FAULTS)
def test_errors_are_found_before_the_first_iteration(case: dict[str, str], make):
    with pytest.raises(SpecError, match=case["message"]):
        make(settings=case["solver"])


def test_the_prefix_of_the_last_snapshot_is_checked_before_training(make):
    solver = make('max_iter: 5 snapshot_prefix: "gone/p"')
    with pytest.raises(SpecError, match=r'cannot write to snapshot prefix "gone/p": No such file or directory'):
        solver.solve()
    assert solver.iteration == 0


def test_solve_refuses_a_second_training_with_the_same_prefix(make):
    solver = make('max_iter: 2 snapshot_prefix: "s"')
    with only_one(".s.lock", ""), pytest.raises(SpecError, match=r'^\.s\.lock: is locked .* not "s" to both'):
        solver.solve()
    assert solver.iteration == 0
    solver.solve()
    assert not Path(".s.lock").exists()


def test_gpu_mode_without_a_gpu_runs_on_the_cpu_and_warns_once(make, monkeypatch, caplog: pytest.LogCaptureFixture):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    with caplog.at_level(logging.WARNING, "netspec"):
        solver = make(settings=SETTINGS.replace("CPU", "GPU"))
        solver.step(1)
    assert solver.net.device.type == "cpu"
    warnings = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert warnings == ["s.prototxt:4:1: solver_mode GPU, but torch finds no GPU; running on the CPU"]


def test_a_missing_gpu_is_refused(make, monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(
        SpecError, match=r"^s\.prototxt:6:1: found device_id 3, but torch finds 1 GPU\(s\) on this machine"
    ):
        make("device_id: 3", settings=SETTINGS.replace("CPU", "GPU"))


# Where it is interrupted


READING = """
layer { name: "data" type: "HDF5Data" top: "data" top: "label" hdf5_data_param { source: "files.txt" batch_size: 1 } }
layer { name: "ip" type: "InnerProduct" bottom: "data" top: "ip"
  inner_product_param { num_output: 2 weight_filler { type: "constant" value: 1 } } }
layer { name: "loss" type: "EuclideanLoss" bottom: "ip" bottom: "label" top: "loss" }
"""


def call_before_updates(solver: Solver, function: Callable[[], object]) -> None:
    class Calling(Callback):
        @override
        def on_gradients_ready(self) -> None:
            function()

    solver.callbacks.append(Calling())


@pytest.mark.parametrize("where", ["after the gradients", "between two updates"])
def test_an_interrupt_waits_for_the_end_of_the_iteration(make, monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    """After Ctrl-C in Python, a training can continue as if nothing had happened."""
    with h5py.File("records.h5", "w") as file:
        file["data"] = np.random.default_rng(0).normal(size=(7, 3)).astype("f4")
        file["label"] = np.zeros((7, 2), "f4")
    Path("files.txt").write_text("records.h5")
    undisturbed = make(net=READING)
    undisturbed.step(5)
    solver = make(net=READING)

    interrupted: list[int] = []

    def interrupt() -> None:
        if solver.iteration == 1 and not interrupted:
            interrupted.append(1)
            signal.raise_signal(signal.SIGINT)

    if where == "after the gradients":
        call_before_updates(solver, interrupt)
    else:
        move = update.move
        monkeypatch.setattr(update, "move", lambda *arguments: (move(*arguments), interrupt()))
    with pytest.raises(KeyboardInterrupt):
        solver.step(5)
    assert solver.iteration == 2
    solver.step(3)
    assert all(map(torch.equal, weights(solver), weights(undisturbed)))


def test_a_second_interrupt_ends_the_iteration_immediately(make) -> None:
    solver = make()

    def interrupt_twice() -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        pytest.fail("the second one is kept too")

    call_before_updates(solver, interrupt_twice)
    with pytest.raises(KeyboardInterrupt):
        solver.step(1)
    assert solver.iteration == 0
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_the_interrupt_handler_of_a_program_is_kept(make, monkeypatch: pytest.MonkeyPatch) -> None:
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        solver = make()
        call_before_updates(solver, lambda: signal.raise_signal(signal.SIGINT))
        solver.step(2)
    finally:
        signal.signal(signal.SIGINT, before)
    assert came == [signal.SIGINT] * 2

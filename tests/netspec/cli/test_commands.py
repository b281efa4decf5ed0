"""The commands, called as ``netspec`` calls them: effects, messages and exit status."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import netspec
from netspec.export.engines.choice import user_folder
from netspec.graph.options import BuildOptions
from netspec.layers import layer_types
from netspec.net.net import Net
from netspec.proto.schema import NetParameter
from netspec.proto.text import read_net, read_solver

NET = "sgd_step/train_val.prototxt"
SOLVER = "sgd_step/solver.prototxt"
INIT = "sgd_step/init.caffemodel"
Run = Callable[..., Any]  # the fixtures of conftest.py
Edit = Callable[..., str]


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["train", "edited.prototxt"],
        ["test", "--model", NET, "--weights", INIT, "--iterations", 1],
        ["time", "--model", NET, "--iterations", 1],
        ["extract", "--model", NET, "--weights", INIT, "--blob", "feat", "--out", "f.npz", "--iterations", 1],
        ["extract", "--model", NET, "--weights", INIT, "--blob", "feat", "--out", "f.npz", "--images", "images"],
    ],
    ids=lambda words: words[0] + "-images" * ("--images" in words),
)
def test_every_command_passes_exact_to_its_nets(
    run: Run, edited: Edit, words: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    edited(SOLVER, "max_iter: 60", "max_iter: 1")
    Path("images").mkdir()
    cv2.imwrite("images/a.png", np.zeros((28, 28), np.uint8))
    built = set()
    build = Net.__init__

    def watched(net: Net, plan: Any, options: BuildOptions) -> None:
        if options.device != "meta":  # where shapes are read off
            built.add(options.exact)
        build(net, plan, options)

    monkeypatch.setattr(Net, "__init__", watched)
    assert run(*words, "--exact", "all").status == 0
    assert built == {"all"}


# train


@pytest.mark.slow
def test_a_solver_without_max_iter_is_not_trained(run: Run, edited: Edit) -> None:
    """Caffe trains nothing and exits with 0; load_solver and step(n) need no max_iter."""
    solver = edited(SOLVER, "max_iter: 60", "")
    reported = "has no max_iter, so there is nothing to train; add max_iter: N, the number of iterations"
    assert run("train", solver).fault == f"{solver}: {reported}"


@pytest.mark.slow
def test_train_applies_level_and_stages_to_the_training_net_only(run: Run, edited: Edit) -> None:
    stage = (
        'layer { name: "extra" type: "Power" bottom: "data" top: "extra" include { stage: "a" min_level: 2 } }\nlayer {'
    )
    net = edited(NET, 'layer {\n  name: "conv1"', stage + '\n  name: "conv1"')
    Path("net.prototxt").write_text(Path(net).read_text())
    solver = edited(SOLVER, NET, "net.prototxt", "max_iter: 60", "max_iter: 1")
    created = [
        [m for m in run("train", solver, *words).messages if m == "Creating Layer extra"]
        for words in ([], ["--stage", "b,a"], ["--stage=a,b", "-level", "2"])
    ]
    assert [len(lines) for lines in created] == [0, 0, 1]


# test and time


def test_test_scores_a_net_on_its_test_data(run: Run) -> None:
    result = run("test", "-model", NET, "-weights", INIT, "-iterations", "3")
    assert result.status == 0
    batches = [line for line in result.messages if line.startswith("Batch ")]
    scores = [float(line.rpartition(" ")[2]) for line in batches]
    assert [line.rpartition(" ")[0] for line in batches] == [f"Batch {i}, loss =" for i in range(3)]
    assert scores[0] == pytest.approx(0.141718, rel=1e-4)
    mean = f"{np.mean(scores):.4g}"
    assert result.messages[-1].startswith(f"loss = {mean}")
    assert result.messages[-2].startswith(f"Loss: {mean}")


def test_time_measures_each_layer(run: Run) -> None:
    result = run("time", "--model", NET, "--phase", "test", "--iterations=2")
    assert result.status == 0
    times = [line for line in result.messages if line.endswith(" ms.")]
    for name in ("slice_pair", "conv1", "loss"):
        assert sum(line.split()[0] == name for line in times) == 2
    assert sum(line.startswith("Iteration: ") for line in times) == 2
    assert (
        "The NetState phase (1) differed from the phase (0) specified by a rule in layer pair_data" in result.messages
    )


# The other commands


def test_upgrades_write_the_current_format(run: Run) -> None:
    old = 'input: "x" input_shape { dim: 1 dim: 2 } layers { name: "r" type: RELU bottom: "x" top: "x" blobs_lr: 1 }'
    Path("old.prototxt").write_text(old)
    Path("solver.prototxt").write_text('net: "old.prototxt" solver_type: ADAM')
    assert run("upgrade_net_proto_text", "old.prototxt", "new.prototxt").status == 0
    assert [(layer.name, layer.type) for layer in read_net("new.prototxt").layer] == [("input", "Input"), ("r", "ReLU")]
    assert "layers" not in Path("new.prototxt").read_text()
    result = run("upgrade_solver_proto_text", "solver.prototxt", "new_solver.prototxt")
    assert result.messages[-1] == "Wrote upgraded SolverParameter text proto to new_solver.prototxt"
    assert read_solver("new_solver.prototxt").type == "Adam"
    assert "solver_type" not in Path("new_solver.prototxt").read_text()
    assert run("upgrade_net_proto_binary", INIT, "new.caffemodel").status == 0
    netspec.load_weights(netspec.load_net(NET), "new.caffemodel")
    assert run("upgrade_net_proto_text", "old.prototxt", "nowhere/new").fault.startswith(
        "nowhere/new: cannot be written"
    )


@pytest.mark.slow
def test_a_user_without_a_name_or_a_home_is_served(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container with ``--user 1234``. glog writes "invalid-user"."""

    def unknown(uid: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    monkeypatch.setattr(pytest.importorskip("pwd"), "getpwuid", unknown)
    for name in ("HOME", "LOGNAME", "USER", "LNAME", "USERNAME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    assert run("time", "-model", NET, "-iterations", "1", "-log_dir", str(tmp_path)).status == 0
    (path,) = tmp_path.glob("caffe.*.log.INFO.*")
    assert ".invalid-user." in path.name
    assert user_folder() is None


def test_layers_prints_the_first_line_of_each_docstring(run: Run) -> None:
    rows = [line.split(maxsplit=1) for line in run("layers").out.splitlines()]
    assert [row[0] for row in rows] == layer_types()
    assert dict(rows)["Silence"] == "Consume blobs that would otherwise be outputs of the net."
    assert all(len(row) == 2 for row in rows)


@pytest.mark.skipif(torch.cuda.is_available(), reason="for machines without a GPU")
def test_without_a_gpu_the_cpu_is_used_and_gpu_is_refused(run: Run, edited: Edit) -> None:
    asked = run("device_query")
    assert (asked.status, asked.messages[-1]) == (0, "No GPU: torch finds none on this machine")
    refused = "torch finds no GPU(s) on this machine; omit --gpu to use the CPU"
    for words in (["train", SOLVER], ["test", "--model", NET, "--weights", INIT], ["time", "--model", NET]):
        assert run(*words, "-gpu", "0").fault == f"--gpu 0: {refused}"
    result = run("train", edited(SOLVER, "solver_mode: CPU", "solver_mode: GPU", "max_iter: 60", "max_iter: 0"))
    assert result.status == 0
    warnings = [line for line in result.messages if "solver_mode" in line and "running on the CPU" in line]
    assert warnings == ["edited.prototxt:11:1: solver_mode GPU, but torch finds no GPU; running on the CPU"]


# What is wrong, in one line


def test_invalid_and_missing_gpus_are_refused(run: Run) -> None:
    fault = "--gpu first: expected a GPU's number, several numbers separated by commas, or all"
    assert run("train", SOLVER, "--gpu=first").fault == fault
    count = torch.cuda.device_count()
    assert f"torch finds {count or 'no'} GPU(s)" in run("train", SOLVER, "--gpu", f"0,{count + 1}").fault


def test_a_net_with_inputs_cannot_be_trained(run: Run, edited: Edit) -> None:
    deploy = 'layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 1 dim: 3 } } }'
    Path("net.prototxt").write_text(deploy)
    expected = "net.prototxt: no value for input 'x'; this net's inputs: x"
    assert run("test", "--model", "net.prototxt", "--weights", INIT).fault == expected
    unfed = 'net.prototxt:1:1: layer "x" (Input): nothing fills "x" during training; use a layer that reads '
    assert run("train", edited(SOLVER, NET, "net.prototxt", "test_iter: 4", "")).fault.startswith(unfed)
    assert run("time", "--model", "net.prototxt", "--iterations", 1).status == 0


# Usage


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ("the following arguments are required: COMMAND", ""),
        ('there is no command "fit"', "fit"),
        ("netspec train: error: need one solver definition: netspec train solver.prototxt", "train"),
        ("need one solver definition", "train a --solver b"),
        ("give a snapshot to resume training or weights to fine-tune", "train s --snapshot a --weights b"),
        ("unrecognized arguments: --momentum", "train s --momentum 0.9"),
        ("argument --sigint_effect: invalid choice: 'die'", "train s -sigint_effect die"),
        ("the following arguments are required: --weights", "test --model m"),
        ("found 0, expected a positive number", "test --model m --weights w --iterations 0"),
        ("found 'data=1x2', expected BLOB=N,C,H,W, e.g. data=32,3,224,224", "check net --shape data=1x2"),
        ("argument --exact: invalid choice: 'some'", "time --model m --exact some"),
        ("found 2147483648, expected -2147483648 to 2147483647", "check net --level 2147483648"),
        ("found -1, expected a number of at least 0", "diff a b --tolerance -1"),
        ("found nan, expected a number of at least 0", "diff a b --tolerance nan"),
        ("argument --phase: invalid choice: 'VAL'", "check net --phase VAL"),
        ("found 'db', expected LAYER=DB", "extract --model m --blob b --out o --source db"),
    ],
)
def test_wrong_usage_ends_with_status_2(run: Run, words: str, said: str) -> None:
    result = run(*words.split())
    assert result.status == 2
    assert said in result.err
    assert "Traceback" not in result.err


def test_help_ends_with_status_0(run: Run) -> None:
    assert "caffe train" in run("--help").out
    result = run("train", "--help")
    assert result.status == 0
    assert "--sighup_effect" in result.out


@pytest.mark.slow
def test_missing_layers_are_a_warning_or_with_strict_an_error(run: Run, edited: Edit) -> None:
    solver = edited(SOLVER, "max_iter: 60", "max_iter: 1")
    part = NetParameter.FromString(Path(INIT).read_bytes())
    for layer in part.layer:
        layer.name = layer.name.replace("conv1", "gone")
    Path("part.caffemodel").write_bytes(part.SerializeToString())
    lacks = "part.caffemodel: lacks weights for 2 of the net's 8 layers with weights: conv1, conv1_p"
    for command in (
        ["test", "--model", NET, "--weights", "part.caffemodel", "--iterations", 1],
        ["train", solver, "--weights", "part.caffemodel"],
        ["check", solver, "--data", "--weights", "part.caffemodel"],
    ):
        result = run(*command)
        assert result.status == 0, result.err
        assert result.err.count(f"{lacks}; they keep the values of their fillers") == 1
        assert run(*command, "--strict").fault == f"{lacks}; without strict they keep their fillers' values"

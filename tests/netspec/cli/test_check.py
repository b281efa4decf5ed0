"""The command ``check``: what a file builds, its errors, and likely mistakes."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

NET = "sgd_step/train_val.prototxt"
SOLVER = "sgd_step/solver.prototxt"
PAIR_SHAPE = ("--shape", "pair_data=4,2,28,28")
Run = Callable[..., Any]  # the fixtures of conftest.py
Edit = Callable[..., str]


def test_check_prints_a_net_as_json(run: Run) -> None:
    result = run("check", NET, "--phase", "TRAIN", *PAIR_SHAPE, "--json")
    assert (result.status, result.err) == (0, "")
    found = json.loads(result.out)
    assert sorted(found) == ["blobs", "inputs", "outputs", "params"]
    assert found["blobs"]["data_p"] == [4, 1, 28, 28]
    assert found["blobs"]["feat"] == [4, 8]
    assert found["blobs"]["loss"] == []
    assert found["params"]["conv1_p"] == [[6, 1, 5, 5], [6]]
    assert (found["inputs"], found["outputs"]) == ([], ["loss"])


def test_check_prints_a_table(run: Run) -> None:
    result = run("check", NET, *PAIR_SHAPE)
    rows = {line.split()[0]: line for line in result.out.splitlines() if line}
    assert rows["conv2"].split() == ["conv2", "Convolution", "pool1", "conv2", "4x8x8x8", "1,208", "0.01", "307,200"]
    assert rows["slice_pair"].split()[3:8] == ["data,", "data_p", "4x1x28x28,", "4x1x28x28", "0.02"]
    assert rows["pair_data"].split()[2] == "-"
    assert rows["conv2_p"].split()[5] == "shared"
    assert rows["total"].split() == ["total", "5,756", "0.20", "1,340,416"]


@pytest.mark.slow
def test_check_shortens_the_list_of_readers_of_a_blob(run: Run, tmp_path: Path) -> None:
    """The longest line determines the width, so it does not list all blobs."""
    net = tmp_path / "net.prototxt"
    net.write_text(
        'layer { name: "data" type: "Input" top: "b" input_param { shape { dim: 1 } } }\n'
        + "".join(f'layer {{ name: "l{i}" type: "ReLU" bottom: "b" top: "t{i}" }}\n' for i in range(1000))
        + 'layer { name: "all" type: "Concat" top: "all" concat_param { axis: 0 } '
        + "".join(f'bottom: "t{i}" ' for i in range(1000))
        + "}\n"
    )
    result = run("check", str(net))
    assert "t19, and 980 more" in result.out
    assert "_split" not in result.out
    assert len(result.out) < 1_000_000


def test_check_can_show_caffes_log(run: Run) -> None:
    quiet, loud = (run("check", NET, *PAIR_SHAPE, *words) for words in ([], ["-v"]))
    assert quiet.err == ""
    assert "Network initialization done." in loud.messages
    assert loud.out == quiet.out


def test_check_accepts_shapes_for_data_layers_and_inputs_only(run: Run) -> None:
    expected = f'{NET}: --shape: no data layer has a top "pair"; did you mean "pair_data"? their tops: pair_data, sim'
    assert run("check", NET, *PAIR_SHAPE, "--shape", "pair=1,2,28,28").fault == expected
    fault = run("check", SOLVER, *PAIR_SHAPE, "--shape", "conv1=1,6,24,24").fault
    assert fault == f'{SOLVER}: --shape: no data layer has a top "conv1"; their tops: pair_data, sim'
    Path("net.prototxt").write_text(
        'layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 1 dim: 3 } } }'
    )
    assert json.loads(run("check", "net.prototxt", "--json", "--shape", "x=5,3").out)["blobs"] == {"x": [5, 3]}


def test_check_filters_by_phase_level_and_stage(run: Run) -> None:
    kinds = ("phase: TRAIN", "phase: TEST", "min_level: 2", 'stage: "a" stage: "b"', 'not_stage: "a"')
    layers = [f'layer {{ name: "l{i}" type: "DummyData" top: "b{i}" dummy_data_param {{ shape {{ dim: 1 }} }} '
              f"include {{ {kind} }} }}" for i, kind in enumerate(kinds)]  # fmt: skip
    Path("net.prototxt").write_text("\n".join(layers))

    def left(*words: str) -> list[str]:
        return json.loads(run("check", "net.prototxt", "--json", *words).out)["outputs"]

    assert left() == ["b1", "b4"]
    assert left("--phase", "TRAIN") == ["b0", "b4"]
    assert left("-phase=train", "-level=2") == ["b0", "b2", "b4"]
    assert left("--stage", "a") == ["b1"]
    assert left("--stage", "b,a", "--level", "3") == ["b1", "b2", "b3"]


def test_check_warns_and_succeeds(run: Run) -> None:
    result = run("check", SOLVER, *PAIR_SHAPE)
    assert result.status == 0
    assert result.err.splitlines() == [
        f"warning: {SOLVER}: no snapshot is taken; set snapshot, or snapshot_after_train: true [no-snapshot]",
        f"warning: {SOLVER}:3:1: test_interval 1000 is more than max_iter 60; lower it [test-after-end]",
    ]


def test_a_warning_of_both_nets_of_a_solver_is_shown_once(run: Run, edited: Edit) -> None:
    net = edited(NET, "pooling_param { pool: MAX", "relu_param { negative_slope: 1 } pooling_param { pool: MAX")
    Path("net.prototxt").write_text(Path(net).read_text())
    for words in (["check", *PAIR_SHAPE], ["train"]):
        result = run(*words, edited(SOLVER, NET, "net.prototxt", "max_iter: 60", "max_iter: 0"))
        assert result.status == 0
        assert result.err.count("relu_param has no effect: a layer of type Pooling does not read it") == 1

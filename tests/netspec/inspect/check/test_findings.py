"""The findings that ``netspec check`` reports about nets and solvers, with their places."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from netspec.cli import main
from netspec.inspect.check.check import ON_META, check_file
from netspec.inspect.check.lint import lint_file
from netspec.proto.schema import TRAIN, PhaseValue
from paths import GOLDEN

DATA = """layer { name: "d" type: "Data" top: "pair" top: "sim"
  data_param { source: "%s" batch_size: 10 backend: LMDB } }
layer { name: "cut" type: "Slice" bottom: "pair" top: "a" top: "b" }
"""
TOWER = """layer { name: "ip%(k)s" type: "InnerProduct" bottom: "%(in)s" top: "f%(k)s" %(param)s
  inner_product_param { num_output: 2 weight_filler { type: "xavier" } } }
"""
LOSS = 'layer { name: "loss" type: "ContrastiveLoss" bottom: "f1" bottom: "f2" bottom: "sim" top: "loss" }\n'
SHARED = ('param { name: "w" } param { name: "b" }',) * 2


def siamese(params: tuple[str, ...] = SHARED, extra: str = "", source: str = "nowhere") -> str:
    towers = "".join(TOWER % {"k": k, "in": blob, "param": p} for k, blob, p in zip("12", "ab", params, strict=True))
    return DATA % source + towers + LOSS + extra


def in_phases(net: str) -> str:
    """Return the net with a data layer for TRAIN, of another database, and its own for TEST only."""
    data, cut, rest = net.partition('layer { name: "cut"')
    source = re.search('source: "(.*)"', data)
    other = data.replace(source[1], str(GOLDEN / "pairs" / "train_lmdb")) if source else data
    both = (
        f"{each.rstrip()[:-1]}include {{ phase: {phase} }} }}" for each, phase in ((data, "TEST"), (other, "TRAIN"))
    )
    return " ".join(both).replace("\n", " ") + f"\n\n{cut}{rest}"


@pytest.fixture
def advice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """``advice(net, solver=None, phase=TRAIN)``: the findings of a net's text, or of a solver's that trains it.

    With ``open_data`` the data layers are opened, else their shapes are given.
    """
    monkeypatch.chdir(tmp_path)

    def check(net: str, solver: str | None = None, phase: PhaseValue = TRAIN, open_data: bool = False) -> list[str]:
        Path("net.prototxt").write_text(net)
        if solver is not None:
            Path("solver.prototxt").write_text('net: "net.prototxt"\n' + solver)
        path = "net.prototxt" if solver is None else "solver.prototxt"
        shapes = {"pair": (10, 2, 4, 4), "sim": (10,)} if "pair" in net and not open_data else {}
        checked = check_file(path, phase, replace(ON_META, given_shapes=shapes, open_data=open_data))
        assert not [fault for part in checked for fault in part.faults]
        return [f"{found.where}: {found.message}" for part in checked for found in part.advice]

    return check


def test_a_correct_net_has_no_findings(advice: Callable[..., list[str]]) -> None:
    assert advice(siamese()) == []


def test_towers_that_share_only_some_parameters_are_found(advice: Callable[..., list[str]]) -> None:
    assert advice(siamese(('param { name: "w" }', 'param { name: "w" }'))) == [
        'net.prototxt:6:1: layer "ip2" (InnerProduct): 1 of its 2 parameter blobs are not shared with the other branch '
        'of "loss"; give them the same param { name }'
    ]


def test_an_unused_blob_is_found(advice: Callable[..., list[str]]) -> None:
    spare = 'layer { name: "spare" type: "ReLU" bottom: "f1" top: "spare" }\n'
    assert advice(siamese(extra=spare)) == [
        'net.prototxt:9:1: layer "spare" (ReLU): no layer uses blob "spare"; remove it, or add a Silence layer'
    ]
    score = 'layer { name: "score" type: "Accuracy" bottom: "f1" bottom: "sim" top: "score" }\n'
    assert advice(siamese(extra=score)) == []
    silent = 'layer { name: "hush" type: "Silence" bottom: "spare" }\n'
    assert advice(siamese(extra=spare + silent)) == []


def test_outputs_of_a_net_without_a_loss_are_not_found_as_unused(advice: Callable[..., list[str]]) -> None:
    assert advice('layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 1 } } }') == []


def test_two_layers_of_one_name_are_found(advice: Callable[..., list[str]]) -> None:
    said = advice(siamese().replace('"ip2"', '"ip1"'))
    assert said == [
        'net.prototxt:6:1: layer "ip1" (InnerProduct): an earlier layer has the same name; loaded weights go to that '
        "layer only; rename one"
    ]


def test_a_blob_of_another_phase_is_reported_with_its_phase(advice: Callable[..., list[str]], tmp_path: Path) -> None:
    net = (DATA % "nowhere").replace('top: "sim"', 'top: "sim" include { phase: TRAIN }')
    Path("net.prototxt").write_text(net)
    (checked,) = check_file("net.prototxt")
    assert [str(fault) for fault in checked.faults] == [
        'net.prototxt:3:35: layer "cut" (Slice): unknown bottom blob "pair": layer "d" of line 1 makes it '
        "in phase TRAIN; use --phase TRAIN, or add such a layer for phase TEST"
    ]
    assert lint_file("net.prototxt", replace(ON_META, given_shapes={"pair": (2, 6, 8, 8)})).faults == []


SOLVER = 'base_lr: 0.1 lr_policy: "fixed" max_iter: 100 snapshot_prefix: "s"\n'


def test_a_correct_solver_has_no_findings(advice: Callable[..., list[str]]) -> None:
    assert advice(in_phases(siamese()), SOLVER + "snapshot: 50") == []


def test_a_test_on_training_data_is_found(advice: Callable[..., list[str]]) -> None:
    source = str(GOLDEN / "pairs" / "train_lmdb")
    tested = SOLVER + "test_interval: 10\ntest_iter: 30\n"
    reported = 'layer "d" (Data): the test reads "%s", which the net is trained on; use another database'
    assert [line.partition(": ")[2] for line in advice(in_phases(siamese(source=source)), tested)] == [
        reported % source
    ]
    same = siamese(source=source)
    assert f"net.prototxt:2:16: {reported % source}" in advice(same, tested, open_data=True)
    assert advice(same, SOLVER) == [
        f'net.prototxt:2:16: layer "d" (Data): a test would also read "{source}", which the net is trained on; '
        "add a data layer for phase TEST"
    ]


def test_a_training_without_snapshots_is_found(advice: Callable[..., list[str]]) -> None:
    without = SOLVER + "snapshot_after_train: false\n"
    assert advice(in_phases(siamese()), without + "snapshot: 101") == [
        "solver.prototxt:4:1: snapshot 101 is more than max_iter 100, so it has no effect; lower it"
    ]
    assert advice(in_phases(siamese()), SOLVER + "snapshot: 101") == [
        "solver.prototxt:3:1: snapshot 101 is more than max_iter 100, so it has no effect; lower it"
    ]
    assert advice(in_phases(siamese()), without) == [
        "solver.prototxt: no snapshot is taken; set snapshot, or snapshot_after_train: true"
    ]
    assert advice(in_phases(siamese()), without + "snapshot: 100") == []


@pytest.mark.parametrize(("iterations", "far"), [(20, False), (19, False), (22, False), (4, True), (64, True)])
def test_a_test_iter_far_from_the_size_of_the_database_is_found(
    advice: Callable[..., list[str]], iterations: int, far: bool
) -> None:
    source = str(GOLDEN / "pairs" / "test_lmdb")
    solver = SOLVER + f"test_interval: 10\ntest_iter: {iterations}"
    read = f"test_iter {iterations} x batch 10 = {10 * iterations}"
    expected = [f'solver.prototxt:4:1: {read}, but layer "d" has 200 records; set test_iter: 20'] if far else []
    assert advice(in_phases(siamese(source=source)), solver, open_data=True) == expected
    assert advice(in_phases(siamese(source=source)), solver) == []


def test_equal_findings_are_one_line(advice: Callable[..., list[str]], capsys: pytest.CaptureFixture[str]) -> None:
    text = 'layer { name: "x" type: "Input" top: "t0" input_param { shape { dim: 1 dim: 4 } } }\n' + "".join(
        f'layer {{ name: "ip{k}" type: "InnerProduct" bottom: "t{k}" top: "t{k + 1}" '
        "inner_product_param { num_output: 4 } }\n"
        for k in range(16)
    )
    text += 'layer { name: "loss" type: "EuclideanLoss" bottom: "t16" bottom: "t0" top: "loss" }'
    Path("many.prototxt").write_text(text)
    for words, stream in ((["check", "--phase", "TRAIN"], "err"), (["lint"], "out")):
        main([*words, "many.prototxt"])
        (line,) = [line for line in getattr(capsys.readouterr(), stream).splitlines() if "zero-weights" in line]
        assert "(also in 15 more places, lines 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17)" in line

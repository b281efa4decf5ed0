"""tools/bench: its rounds, its tables, its words for what cannot run."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

import netspec
from benchmarks import case, environment, whole
from benchmarks.cli import WHOLE, main
from benchmarks.detectors import ssd300
from benchmarks.report import Row, table
from benchmarks.rounds import difference, measure, ratio


@pytest.fixture(autouse=True)
def _threads() -> Iterator[None]:
    """The program chooses how many threads its process has."""
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


class Clock:
    """Something that takes turns and says that its passes take so long."""

    def __init__(self, name: str, seconds: float, turns: list[str]) -> None:
        self.name, self.seconds, self.turns, self.fault, self.outputs = name, seconds, turns, "", {}
        self.peak: float | None = None

    def turn(self, passes: int) -> list[tuple[float, float]]:
        self.turns.append(self.name)
        return [(self.seconds, 2 * self.seconds)] * passes

    def close(self) -> None:
        pass


def test_all_take_their_turn_in_every_round_in_either_order() -> None:
    turns: list[str] = []
    found = measure([Clock("a", 0.1, turns), Clock("b", 0.2, turns)], 3, lambda k: None)
    assert turns == ["a", "b", "a", "b", "b", "a", "a", "b"]  # the first two say how many passes a turn has
    assert found == {"a": [(0.1, 0.2)] * 3, "b": [(0.2, 0.4)] * 3}


def test_a_ratio_is_that_of_times_in_the_same_round() -> None:
    assert ratio([1, 10, 3], [2, 20, 3]) == 0.5


def test_a_difference_is_relative_and_needs_equal_shapes() -> None:
    expected = {"a": np.array([1, 2, 4.0])}
    assert difference({"a": np.array([[1, 2, 3.0]])}, expected) == 0.25
    assert difference({"a": np.zeros(2)}, expected) is None
    assert difference({}, expected) is None


def test_a_table_has_the_ratios_of_what_ran_and_a_line_for_what_did_not() -> None:
    rows = [
        Row(
            "lenet",
            1,
            2,
            "netspec",
            [1e-3, 3e-3, 2e-3],
            [5e-3] * 3,
            {"pytorch": 0.5},
            None,
            "",
            {"pytorch": 0.75},
            612.3,
        ),
        Row("lenet", 1, 2, "pytorch", [4e-3] * 3, [8e-3] * 3, {}, 1e-7),
        Row("lenet", 1, 2, "opencv4", [], [], {}, None, "it cannot"),
    ]
    lines = table(rows).splitlines()
    assert (
        lines[0] == "| net | batch | threads | run by | ms | best | CPU ms | / pytorch | CPU / pytorch | MB | off by |"
    )
    assert lines[2:] == [
        "| lenet | 1 | 2 | netspec | 2.00 | 1.00 | 5.00 | 0.50 | 0.75 | 612 | - |",
        "| lenet | 1 | 2 | pytorch | 4.00 | 4.00 | 8.00 | - | - | - | 1e-07 |",
        "| lenet | 1 | 2 | opencv4 | - | - | - | - | - | - | - |",
    ]


@pytest.mark.slow
def test_forward_passes_are_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "lenet.json"
    ways = ["--with", "netspec", "pytorch", "pycaffe"]
    assert main(["forward", "lenet", *ways, "--rounds", "1", "--json", str(out)]) == 0
    assert "| lenet | 1 | 1 | pytorch |" in capsys.readouterr().out
    written = json.loads(out.read_text())
    assert [row["run by"] for row in written["rows"]] == ["netspec", "pytorch", "pycaffe"]
    assert all(row["what"] == "forward" and row["ms"] > 0 for row in written["rows"])
    assert written["rows"][1]["off by"] < 1e-5
    assert written["machine"]["cores"] > 0
    assert written["date"] > "2026"
    assert written["command"].startswith("tools/bench forward lenet --with netspec")


@pytest.mark.slow
def test_trainings_are_compared(tmp_path: Path) -> None:
    out = tmp_path / "lenet.json"
    words = ["--batch", "4", "--rounds", "1", "--json", str(out)]
    assert main(["train", "lenet", "--with", "netspec", "pytorch", *words]) == 0
    rows = json.loads(out.read_text())["rows"]
    assert [row["run by"] for row in rows] == ["netspec", "pytorch"]
    assert all(row["ms"] > 0 for row in rows)
    assert rows[1]["off by"] < 1e-5


def test_what_cannot_run_is_reported_in_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(case, "write_torch", lambda net, path: None)
    net = tmp_path / "net.prototxt"
    net.write_text('layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 } } }')
    assert main(["forward", str(net), "--with", "pytorch", "--rounds", "1"]) == 0
    captured = capsys.readouterr()
    assert captured.err.splitlines()[-1].startswith("pytorch: netspec export --to torch cannot write this net")
    assert main(["train", "resnet51"]) == 1
    assert 'no training of "resnet51"' in capsys.readouterr().err


@pytest.mark.slow
def test_growth_is_measured_and_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "growth.json"
    assert main(["growth", "12", "22", "--json", str(out)]) == 0
    cells = [line.split(" | ")[0] for line in capsys.readouterr().out.splitlines()]
    assert cells == ["| frames", "| ---", "| 12", "| 22"]
    rows = json.loads(out.read_text())["rows"]
    assert [row["frames"] for row in rows] == [12, 22]
    assert all(value >= 0 for row in rows for value in row.values())
    assert all(row["memory, MB"] > 10 for row in rows)


@pytest.mark.slow
def test_whole_programs_are_compared(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without OpenCV 4, which has an environment of its own."""
    peers = {"mtcnn": ("netspec", "pytorch"), "training": ("netspec",)}
    monkeypatch.setattr(whole, "PEERS", peers)
    monkeypatch.setattr(whole, "ITERATIONS", 2)
    monkeypatch.setattr(environment, "python", lambda: sys.executable)
    out = tmp_path / "programs.json"
    assert main(["programs", *peers, "--threads", "1", "--rounds", "1", "--json", str(out)]) == 0
    assert "| mtcnn | 1 | 1 | netspec |" in capsys.readouterr().out
    rows = json.loads(out.read_text())["rows"]
    assert [(row["net"], row["run by"]) for row in rows] == [(name, peer) for name in peers for peer in peers[name]]
    assert all(row["what"] == "program" and row["CPU ms"] > 0 for row in rows)
    assert rows[1]["off by"] < 1e-4


def test_an_unknown_program_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(environment, "python", lambda: sys.executable)
    assert tuple(whole.PEERS) == WHOLE
    assert main(["programs", "yolo"]) == 1
    assert 'no program "yolo"; there are: mtcnn, ssd300' in capsys.readouterr().err


@pytest.mark.slow
def test_the_prototxt_of_ssd300_has_8732_priors(tmp_path: Path) -> None:
    (tmp_path / "ssd300.prototxt").write_text(ssd300())
    net = netspec.load_net(tmp_path / "ssd300.prototxt")
    assert net.shapes["loc"] == (1, 4 * 8732)
    assert net.shapes["detections"] == (1, 1, 1, 7)

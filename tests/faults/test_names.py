"""Control characters in names are escaped in terminals, logs and errors."""

import logging
from pathlib import Path

import pytest

from loopclosure.errors import InputError
from netspec import log
from netspec.cli import main
from netspec.errors import SpecError, Where

EVIL = "a\\033[31m\\nI1122 10:00:00.000000     1 solver.cpp:239] Iteration 99999, loss = 0\\r\\302\\233"
NET = f"""name: "{EVIL}"
layer {{ name: "{EVIL}" type: "DummyData" top: "{EVIL}" dummy_data_param {{ shape {{ dim: 2 dim: 3 }} }} }}
layer {{ name: "ip" type: "InnerProduct" bottom: "{EVIL}" top: "ip"
  inner_product_param {{ num_output: 2 weight_filler {{ type: "xavier" }} }} }}
layer {{ name: "loss" type: "EuclideanLoss" bottom: "ip" bottom: "ip" top: "{EVIL}loss" }}
"""
SOLVER = (
    'net: "net.prototxt" base_lr: 0.1 lr_policy: "fixed" max_iter: 2 display: 1 snapshot_prefix: "x" solver_mode: CPU'
)


@pytest.mark.parametrize(
    "words",
    ["train solver.prototxt", "time --model net.prototxt --iterations 1", "check net.prototxt", "check odd.prototxt"],
    ids=["train", "time", "check", "check_invalid"],
)
def test_control_characters_in_names_are_escaped_in_the_output_of_commands(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("net.prototxt").write_text(NET)
    Path("odd.prototxt").write_text(NET.replace('bottom: "a', 'bottom: "b'))
    Path("solver.prototxt").write_text(SOLVER)
    assert main(words.split()) == int("odd" in words)
    said = "".join(capsys.readouterr())
    assert "Iteration 99999" in said
    assert not {character for character in said if ord(character) < 32 or 127 <= ord(character) < 160} - {"\n", "\t"}
    assert not [line for line in said.splitlines() if line.startswith("I1122 10:00:00")]


@pytest.mark.parametrize(
    "error",
    [SpecError("x\x1b[0m\ny", Where("f\n")), InputError("x\x1b[0m\ny", "f\n")],
    ids=["SpecError", "InputError"],
)
def test_control_characters_in_errors_are_escaped(error: Exception) -> None:
    assert str(error) == r"f\n: x\x1b[0m\ny"


def test_log_dump_keeps_the_lines_of_a_text_and_log_info_escapes_them(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "netspec")
    log.dump("net.cpp:53", "title\n", "a: 1\nb: 2")
    log.info("net.cpp:53", "one\nline")
    assert caplog.messages == ["title\\n\na: 1\nb: 2", "one\\nline"]

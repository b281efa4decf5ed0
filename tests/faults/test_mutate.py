"""mutate.py, texts.py and kill.py, which damage files and texts and kill commands at random, with few tries."""

import sys
from pathlib import Path

import pytest

import forked
from faults.formats import FORMATS

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks; reads /proc")]

SLOW = ("exported net", "drawn net")  # each read takes a while


@pytest.mark.parametrize(
    ("tries", "formats"),
    [("80", [name for name in FORMATS if name not in SLOW]), ("6", list(SLOW))],
    ids=["fast_formats", "slow_formats"],
)
def test_randomly_damaged_files_are_refused_in_one_line(tries: str, formats: list[str], tmp_path: Path) -> None:
    program = Path(__file__).with_name("mutate.py")
    done = forked.run(forked.script, program, ["--tries", tries, *formats], folder=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(f": 0 of {tries}\n") == len(formats)


def test_texts_with_randomly_replaced_words_are_refused_in_one_line(tmp_path: Path) -> None:
    pytest.importorskip("hypothesis")
    done = forked.run(forked.script, Path(__file__).with_name("texts.py"), ["--tries", "50"], folder=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(": 50 texts, no fault\n") > 8


def test_killed_commands_leave_complete_files_and_no_process(tmp_path: Path) -> None:
    kills = "2"  # one at any time, one while a file is written
    done = forked.run(forked.script, Path(__file__).with_name("kill.py"), ["--kills", kills], folder=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) >= 7
    assert all("0 broken or lost, 0 orphans, 0 leftovers" in line for line in lines)

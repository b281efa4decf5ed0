"""The file with a training's test results and snapshots, for other programs."""

from pathlib import Path

import pytest

from netspec.cli.scores import Score, Scores, read_scores
from netspec.errors import SpecError


def test_values_that_are_no_numbers_are_kept(tmp_path: Path) -> None:
    Scores([Score(3, 0, {"loss": [float("inf"), float("nan")]})]).write(tmp_path / "scores.json")
    (test,) = read_scores(tmp_path / "scores.json").tests
    assert [str(value) for value in test.outputs["loss"]] == ["inf", "nan"]


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "1", '{"tests": []}', '{"tests": [1], "snapshots": []}', '{"tests": [{}], "snapshots": []}']
)
def test_another_file_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "f.json").write_text(text)
    with pytest.raises(SpecError) as fault:
        read_scores(tmp_path / "f.json")
    assert str(fault.value).startswith(f"{tmp_path}/f.json: this is not a file written by netspec train --scores: ")
    assert "\n" not in str(fault.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=r"nowhere\.json: cannot be read: No such file"):
        read_scores(tmp_path / "nowhere.json")

"""tools/bench settings: drives whose loops are known."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from benchmarks import drives, revisits, settings


def test_a_route_in_another_season_has_the_same_places(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name in ("a", "b"):
        (tmp_path / "sequences" / name).mkdir(parents=True)
        for i in range(40):
            picture = cv2.resize(rng.integers(0, 256, (12, 16, 3), np.uint8), (64, 48))
            cv2.imwrite(str(tmp_path / "sequences" / name / f"{i:06d}.jpg"), picture)
    (tmp_path / "sequences" / "index.csv").write_text("name,has_revisits\na,no\nb,no\nc,yes\n")
    made = {drive.kind: drive.data for drive in drives.drives(tmp_path, tmp_path / "work", ["a"])}
    assert len(made["season 2"].queries.paths) == 40
    assert made["season 2"].truth.hard.sum(axis=1).tolist() == [2, *[3] * 38, 2]
    assert len(made["keyframes"].references or []) == 10
    assert made["in part"].truth.queries_with_a_loop.tolist() == [False] * 20 + [True] * 20
    assert made["comes back"].truth.queries_with_a_loop.sum() == 20
    assert made["shares nothing"].truth.positives == 0
    again = drives.in_season(list(made["season 2"].database.paths), tmp_path / "other", 2)
    assert Path(again[5]).read_bytes() == Path(made["season 2"].queries.paths[5]).read_bytes()


def test_the_results_of_each_half_are_summarized() -> None:
    silent = settings.Result("a", "b", 9, 0, 1.0, 0.0, [])
    right = settings.Result("a", "b", 9, 8, 1.0, 0.8, [])
    wrong = settings.Result("a", "b", 9, 8, 0.9, 0.8, [])
    assert [result.precise for result in (silent, right, wrong)] == [True, True, False]
    assert settings.line(wrong).endswith("0.900  0.800 WRONG")
    assert settings.line(right).endswith("1.000  0.800")
    half = replace(right, family=drives.FIRST_HALF[0])
    first, second = settings.halves([half, silent, wrong]).split("first half:")
    assert drives.FIRST_HALF[0] in first
    assert second.split("\n")[0].split() == "1 of 1 drives with a precision of 0.99; mean recall 0.80".split()
    assert "second half:            1 of 2 drives" in second
    assert settings.summary([silent, right, wrong]) == "2 of 3 drives with a precision of 0.99; mean recall 0.53"


def test_two_runs_in_one_folder_keep_the_results_of_both(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def drives_of(data: Path, work: Path, only: list[str]) -> list[SimpleNamespace]:
        return [SimpleNamespace(family=name, kind="laps", name=f"{name}/laps") for name in only]

    def measured(drive: SimpleNamespace, cache: settings.Cache) -> settings.Result:
        if drive.family == "a":  # the other run ends meanwhile
            settings.run(tmp_path, tmp_path, ["b"], print)
        return settings.Result(drive.family, drive.kind, 9, 8, 1.0, 0.8, [])

    monkeypatch.setattr(settings, "drives", drives_of)
    monkeypatch.setattr(settings, "measure", measured)
    assert {result.family for result in settings.run(tmp_path, tmp_path, ["a"], print)} == {"a", "b"}


def test_real_drives_are_judged_by_two_rules_and_only_by_pairs_that_count() -> None:
    """Frame 9 shows frame 1, 10 frame 5 at another angle, 11 another place, and 8 the frame before it."""
    rule, wide = np.zeros((2, 12, 12), bool)
    rule[9, 1] = wide[9, 1] = wide[10, 5] = True
    real = revisits.Real("a", [Path(f"{i}.png") for i in range(12)], rule, wide, revisits._pairs_before(12, 2), gap=2)
    match = np.full(12, -1)
    match[8:] = 7, 1, 5, 0
    row = revisits.judged(real, match, "detect")
    assert {name: row[name] for name in ("frames", "accepted", "right 15", "right 45")} == {
        "frames": 12,
        "accepted": 3,
        "right 15": 1,
        "right 45": 2,
    }
    assert (row["recall 15"], row["recall 45"], row["with a loop 45"]) == (1.0, 1.0, 2)
    assert revisits.judged(real, match, "map query")["accepted"] == 3
    road = replace(real, name="road: a")
    assert [revisits.judged(road, match, how)["chosen on"] for how in revisits.HOW] == ["", "", "yes"]
    assert [part.tolist() for part in real.third(1)] == [[4, 5, 6, 7], [0, 1, 2, 3, 8, 9, 10, 11]]

"""Sequences while frames arrive: what they find of another season, how late, and what speaks against them."""

from typing import Any

import numpy as np
import pytest

from loopclosure.decision.decider import Decider
from loopclosure.detector.decision import LoopResult
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.verification import Agreement, GeometricCheck, LocalFeatures

LAP, NOTHING = 240, LocalFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8))


class Said(GeometricCheck):
    """A check whose images are numbers of frames; all pairs agree as ``agreed`` says."""

    agreed = Agreement(0, 0, 20)

    def describe(self, image: np.ndarray) -> LocalFeatures:
        return NOTHING

    def agreement(self, a: LocalFeatures, b: LocalFeatures) -> Agreement:
        return self.agreed


class Alike(Said):
    """Points of two floors of a tower: enough agree, but only a part of those that match."""

    agreed = Agreement(60, 22, 20)


def seasons(backwards: bool = False) -> np.ndarray:
    """Descriptors of a lap in summer and of one in winter: a single image tells little, neighbors are alike."""
    rng = np.random.default_rng(0)
    places = rng.normal(size=(LAP + 2, 32))
    lap = places[:-2] + places[1:-1] + places[2:]
    again = lap[::-1] if backwards else lap
    return np.concatenate([lap, again + 3 * rng.normal(size=32) + 1.5 * rng.normal(size=lap.shape)]).astype(np.float32)


def run(detector: LoopDetector, rows: np.ndarray, first: int = 0) -> list[list[LoopResult]]:
    """Return the loops that become certain with each frame."""
    image = np.zeros((2, 2), np.uint8)
    return [detector.add_descriptor(row, float(number), image=image) for number, row in enumerate(rows, first)]


@pytest.mark.parametrize("backwards", [False, True])
def test_a_lap_in_another_season_is_found_at_most_ten_frames_late(backwards: bool) -> None:
    detector = LoopDetector(None, check=Said())
    found = run(detector, seasons(backwards))
    for number, certain in enumerate(found):
        for late in certain:  # no single image is a loop by its points
            assert (number - late.query, late.score_of, late.verdict) == (10, "sequence", "accepted")
            assert late.reason.startswith("sequence: ")
            assert late.stamp == late.query
    assert [loop for certain in found for loop in certain] == detector.loops
    loops = {loop.query: loop.match for loop in detector.loops}
    truth = {k: 2 * LAP - 1 - k if backwards else k - LAP for k in loops}
    assert all(abs(int(loops[k] or 0) - truth[k]) <= 2 for k in loops)
    assert len(loops) >= LAP / 2


def test_points_of_which_only_a_part_agrees_speak_against_a_sequence(monkeypatch) -> None:
    monkeypatch.setattr(Decider, "_learn", lambda *_: None)  # unlike pairs have none in common
    assert not run_loops(LoopDetector(None, check=Alike()))


def test_a_sequence_does_not_overrule_a_threshold() -> None:
    assert not run_loops(LoopDetector(None, check=Said(), threshold=-1.0))


def test_a_road_driven_once_has_no_sequences() -> None:
    rng = np.random.default_rng(1)
    road = np.cumsum(0.3 * rng.normal(size=(2 * LAP, 32)), axis=0) + rng.normal(size=(2 * LAP, 32))
    assert not run_loops(LoopDetector(None, check=Said()), road)


def run_loops(detector: LoopDetector, rows: np.ndarray | None = None) -> list[Any]:
    run(detector, seasons() if rows is None else rows)
    return detector.loops


@pytest.mark.slow
def test_a_saved_detector_continues_its_sequences(tmp_path) -> None:
    whole, first = LoopDetector(None, check=Said()), LoopDetector(None, check=Said())
    expected, rows, at = run(whole, seasons()), seasons(), 2 * LAP - 40
    run(first, rows[:at])
    first.save(tmp_path / "x.npz")
    again = LoopDetector.load(tmp_path / "x.npz")
    again._decider.check = again.check = Said()
    again._decider._agree = lambda *_: Said.agreed
    later = run(again, rows[at:], at)
    assert later == expected[at:]
    assert any(later)

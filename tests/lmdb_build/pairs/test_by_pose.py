"""Pairs by pose: scenes, frames of reference, where negatives come from, and what is warned about."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lmdb_build.pairs.by_pose import PoseRule, PoseSource, Scenes
from lmdb_build.pairs.choose import LEFT_OUT, NEGATIVE, POSITIVE
from loopclosure.errors import InputError
from loopclosure.places.image_sequence import ImageSequence


def sequence(name: str, views: list[tuple[float, float, float]]) -> ImageSequence:
    """Frames at (second, x in meters, heading in degrees)."""
    stamps, x, heading = np.array(views, float).T
    quaternions = Rotation.from_euler("y", heading[:, None], degrees=True).as_quat()
    positions = np.column_stack([x, np.zeros((len(x), 2))])
    names = tuple(f"rgb/{stamp:g}.png" for stamp in stamps)
    return ImageSequence((), names, stamps, Path(name), poses=np.hstack([positions, quaternions]))


# Index: 0 and 1 are neighbors in time and place, 2 a revisit of 0, 3 turned by 20 degrees, 4 by 90, 5 far away.
VIEWS = [(0.0, 0.0, 0.0), (0.5, 0.1, 1.0), (20.0, 0.3, 5.0), (30.0, 0.0, 20.0), (40.0, 0.0, 90.0), (50.0, 9.0, 0.0)]
# Another run: 6 is where 0 is, 7 is far away.
OTHER = [(100.0, 0.2, 2.0), (110.0, 30.0, 0.0)]


def two(rule: PoseRule | None = None, scenes: Scenes | None = None) -> PoseSource:
    return PoseSource(
        [sequence("a", VIEWS), sequence("b", OTHER)], ["data/a", "b"], rule or PoseRule(), scenes or Scenes()
    )


def label(source: PoseSource, first: int, second: int) -> int:
    return int(source.judge(np.array([first]), np.array([second]))[0])


def test_names_are_below_the_root() -> None:
    assert two().names[:1] + two().names[-1:] == ["data/a/rgb/0.png", "b/rgb/110.png"]
    assert PoseSource([sequence("a", VIEWS)], ["."]).names[0] == "rgb/0.png"


def test_the_papers_rule() -> None:
    source = two()
    assert [label(source, 0, other) for other in (1, 2, 3, 4, 5)] == [1, 1, 0, 0, 0]
    assert [label(source, 0, other) for other in (6, 7)] == [NEGATIVE, NEGATIVE]


def test_a_minimum_time_gap_applies_within_a_sequence_only() -> None:
    source = two(PoseRule(min_gap_s=25.0))
    assert [label(source, 0, other) for other in (1, 2, 3)] == [LEFT_OUT, LEFT_OUT, NEGATIVE]
    close = two(PoseRule(min_gap_s=1e6))
    assert label(close, 0, 6) == NEGATIVE


@pytest.mark.parametrize(
    ("negatives", "expected"),
    [("same_sequence", [NEGATIVE, LEFT_OUT]), ("cross_sequence", [LEFT_OUT, NEGATIVE]), ("both", [NEGATIVE] * 2)],
)
def test_negatives_come_from_the_chosen_sequences(negatives: str, expected: list[int]) -> None:
    source = two(PoseRule(negatives=negatives))
    assert [label(source, 0, 5), label(source, 0, 7)] == expected
    assert label(source, 0, 2) == POSITIVE


def test_sequences_of_one_scene_give_no_pairs_across() -> None:
    source = two(scenes=Scenes(same_scene=(("a", "b"),)))
    assert [label(source, 0, 6), label(source, 0, 7)] == [LEFT_OUT, LEFT_OUT]


def test_sequences_that_share_a_frame_of_reference_are_judged_by_pose() -> None:
    source = two(scenes=Scenes(same_frame=(("a", "b"),)))
    assert [label(source, 0, 6), label(source, 0, 7), label(source, 5, 6)] == [POSITIVE, NEGATIVE, NEGATIVE]
    assert np.isfinite(source.measures(np.array([0]), np.array([6]))["distance [m]"]).all()
    alone = two(PoseRule(negatives="same_sequence"), Scenes(same_frame=(("a", "b"),)))
    assert [label(alone, 0, 6), label(alone, 0, 7)] == [POSITIVE, LEFT_OUT]


def test_clear_negatives_omit_ambiguous_pairs() -> None:
    by_angle = two(PoseRule(clear_view_angle_deg=50))
    assert [label(by_angle, 0, other) for other in (2, 3, 4, 5)] == [POSITIVE, LEFT_OUT, NEGATIVE, LEFT_OUT]
    by_either = two(PoseRule(clear_view_angle_deg=50, clear_distance_m=5))
    assert [label(by_either, 0, other) for other in (2, 3, 4, 5)] == [POSITIVE, LEFT_OUT, NEGATIVE, NEGATIVE]
    assert label(by_angle, 0, 7) == NEGATIVE  # another scene is clear enough


def test_labels_do_not_depend_on_the_order() -> None:
    source = two(PoseRule(min_gap_s=1.0, clear_view_angle_deg=30), Scenes(same_frame=(("a", "b"),)))
    first, second = np.triu_indices(8, 1)
    assert np.array_equal(source.judge(first, second), source.judge(second, first))


def test_unknown_and_duplicate_names_are_refused() -> None:
    with pytest.raises(InputError, match='no sequence has the name "c"; there are: a, b'):
        two(scenes=Scenes(same_scene=(("a", "c"),)))
    with pytest.raises(InputError, match='two sequences have the name "a"'):
        PoseSource([sequence("a", VIEWS), sequence("a", VIEWS)], ["x/a", "y/a"])


def warned(source: PoseSource, pairs: list[tuple[int, int]]) -> str:
    first, second = np.array(pairs).T
    return "\n".join(source.warnings(first, second, source.judge(first, second)))


def test_a_warning_for_negatives_across_undeclared_sequences() -> None:
    pairs = [(0, 2), (0, 4), (0, 6)]
    assert "1 negatives are of different sequences that are not declared" in warned(two(), pairs)
    assert not warned(two(scenes=Scenes(all_others_differ=True)), pairs)
    assert not warned(two(scenes=Scenes(same_scene=(("a", "b"),))), pairs)


def test_a_warning_for_positives_that_are_neighbors_in_time() -> None:
    assert "100% of the positives are images less than 3 s apart" in warned(two(), [(0, 1), (0, 4)])
    assert not warned(two(), [(0, 2), (0, 4)])


def test_a_warning_for_negatives_near_the_limits() -> None:
    assert "100% of the negatives judged by pose" in warned(two(), [(0, 2), (0, 3)])
    assert not warned(two(), [(0, 2), (0, 4)])

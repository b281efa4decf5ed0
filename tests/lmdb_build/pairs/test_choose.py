"""The choice of pairs: seeded, balanced, no image in two splits, every label as the rule has it."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from lmdb_build.pairs import choose as pairs_room
from lmdb_build.pairs.build import Plan, build_lists
from lmdb_build.pairs.by_pose import PoseRule, PoseSource
from lmdb_build.pairs.choose import (
    NEGATIVE,
    POSITIVE,
    find_pairs,
    split_by_group,
    split_by_time,
)
from lmdb_build.pairs.list_file import read_pair_list
from loopclosure.errors import InputError
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.same_place import same_place


def wander(name: str, count: int, seed: int, start_s: float = 0.0) -> ImageSequence:
    """A camera that turns and strays about, back to where it was now and then."""
    rng = np.random.default_rng(seed)
    stamps = start_s + np.arange(count) / 10
    yaw = np.cumsum(rng.normal(0, 0.12, count))
    positions = np.cumsum(rng.normal(0, 0.15, (count, 3)), axis=0)
    quaternions = np.column_stack([np.zeros((count, 2)), np.sin(yaw / 2), np.cos(yaw / 2)])
    names = tuple(f"rgb/{stamp:.6f}.png" for stamp in stamps)
    return ImageSequence((), names, stamps, Path(name), poses=np.hstack([positions, quaternions]))


def pose_source(lengths: tuple[int, ...] = (120, 90, 110), rule: PoseRule | None = None) -> PoseSource:
    sequences = [wander(f"s{number}", length, number) for number, length in enumerate(lengths)]
    return PoseSource(sequences, [sequence.name for sequence in sequences], rule or PoseRule())


def everything(source: PoseSource) -> np.ndarray:
    return np.arange(len(source.names))


def build(source: PoseSource, plan: Plan, out: Path) -> dict[str, Path]:
    return {split: written.path for split, written in build_lists(source, plan, out.parent, out).items()}


def as_sets(pairs: np.ndarray) -> set[tuple[int, int]]:
    return {(min(a, b), max(a, b)) for a, b in pairs.tolist()}


@pytest.mark.slow
@pytest.mark.parametrize("by", ["time", "group"])
@pytest.mark.parametrize("lengths", [(120, 90, 110), (61, 200, 40, 77)])
def test_lists_are_balanced_disjoint_and_labeled_by_the_rule(tmp_path: Path, by: str, lengths: tuple[int, ...]) -> None:
    rule = PoseRule(min_gap_s=0.25)
    source = pose_source(lengths, rule)
    index = {name: number for number, name in enumerate(source.names)}
    counts = {"train": 120, "val": 40, "test": 30}
    lists = build(source, Plan(counts, seed=1, by=by), tmp_path / "lists")
    images: dict[str, set[str]] = {}
    for split, path in lists.items():
        listed = read_pair_list(path)
        assert len(listed) == counts[split]
        assert sum(pair.label for pair in listed) == counts[split] // 2
        assert len({frozenset((pair.first, pair.second)) for pair in listed}) == counts[split]
        images[split] = {name for pair in listed for name in (pair.first, pair.second)}
        for pair in listed:
            a, b = index[pair.first], index[pair.second]
            same_sequence = source.groups[a] == source.groups[b]
            place = bool(same_place(source.poses[a], source.poses[b])) and same_sequence
            assert pair.label == int(place)
            assert not same_sequence or abs(source.stamps[a] - source.stamps[b]) >= rule.min_gap_s
    assert not images["train"] & images["val"]
    assert not images["train"] & images["test"]
    assert not images["val"] & images["test"]


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    plan = Plan({"train": 100, "val": 40, "test": 0}, seed=5)
    first, second = (build(pose_source(), plan, tmp_path / name) for name in ("a", "b"))
    other = build(pose_source(), Plan(plan.counts, seed=6), tmp_path / "c")
    assert set(first) == {"train", "val"}
    for split in first:
        assert first[split].read_bytes() == second[split].read_bytes()
        assert first[split].read_bytes() != other[split].read_bytes()


def test_a_split_does_not_change_when_another_gets_more_pairs(tmp_path: Path) -> None:
    few, many = (
        build(pose_source(), Plan({"train": train, "val": 40, "test": 40}), tmp_path / str(train))["val"]
        for train in (20, 200)
    )
    assert few.read_bytes() == many.read_bytes()


def test_the_list_is_shuffled(tmp_path: Path) -> None:
    path = build(pose_source(), Plan({"train": 200}), tmp_path / "lists")["train"]
    labels = [pair.label for pair in read_pair_list(path)]
    assert 30 < sum(labels[:100]) < 70
    assert labels != sorted(labels)


def test_a_split_by_time_keeps_ranges_with_a_gap_between_them() -> None:
    source = pose_source()
    splits = split_by_time(source, {"train": 0.5, "val": 0.25, "test": 0.25}, gap=1.0)
    for track in range(3):
        spans = []
        for images in splits.values():
            stamps = source.stamps[images[source.tracks[images] == track]]
            np.testing.assert_allclose(np.diff(stamps), 0.1)
            spans.append((stamps[0], stamps[-1]))
        for (_, end), (begin, _) in pairwise(spans):
            assert begin - end >= 1.0 - 1e-9
    assert len(splits["train"]) == 160


def test_a_split_by_group_gives_each_split_whole_sequences() -> None:
    source = pose_source((50, 60, 70, 80, 90))
    for shares, sizes in (((0.6, 0.2, 0.2), [3, 1, 1]), ((0.98, 0.01, 0.01), [3, 1, 1]), ((0.1, 0.1, 0.8), [1, 1, 3])):
        for seed in range(5):
            splits = split_by_group(source, dict(zip(("train", "val", "test"), shares, strict=True)), seed)
            owners = [set(source.groups[images].tolist()) for images in splits.values()]
            assert [len(owner) for owner in owners] == sizes
            assert set.union(*owners) == set(range(5))


def test_sequences_can_be_given_to_splits_by_name() -> None:
    source = pose_source()
    splits = split_by_group(source, {"train": 0.5, "val": 0.5}, 1, {"val": ["s1"], "test": ["s2"]})
    assert set(source.groups[splits["train"]].tolist()) == {0}
    assert set(source.groups[splits["val"]].tolist()) == {1}


@pytest.mark.parametrize(
    ("lengths", "named", "words"),
    [
        ((9, 9, 9), {"val": ["s1"]}, "name the sequences of all splits but one; not named: train, test"),
        ((9, 9, 9), {"val": ["s9"], "test": ["s1"]}, 'no sequence has the name "s9"; there are: s0, s1, s2'),
        ((9, 9, 9), {"val": ["s1"], "test": ["s1"]}, 'sequence "s1" is named for two splits'),
        ((50,), None, "1 sequence cannot be split by sequence into train and val and test"),
    ],
)
def test_sequences_that_cannot_be_split_are_refused(
    lengths: tuple[int, ...], named: dict[str, list[str]] | None, words: str
) -> None:
    with pytest.raises(InputError, match=words):
        split_by_group(pose_source(lengths), {"train": 0.5, "val": 0.25, "test": 0.25}, 1, named)


def test_too_few_pairs_are_an_error_with_their_number(tmp_path: Path) -> None:
    source = pose_source((30,), PoseRule(negatives="same_sequence"))
    pairs = [(a, b) for a in range(30) for b in range(a + 1, 30)]
    labels = source.judge(*np.array(pairs).T)
    positives, negatives = int((labels == POSITIVE).sum()), int((labels == NEGATIVE).sum())
    with pytest.raises(
        InputError, match=f"{positives} positive and {negatives} negative pairs; .* --at-most"
    ) as caught:
        build(source, Plan({"train": 2000}), tmp_path / "lists")
    assert str(caught.value).startswith("train: 2000 pairs need 1000 of each label")
    assert not (tmp_path / "lists").exists()
    path = build(source, Plan({"train": 2000}, at_most=True), tmp_path / "lists")["train"]
    taken = read_pair_list(path)
    assert len(taken) == 2 * min(positives, negatives)
    assert sum(pair.label for pair in taken) == min(positives, negatives)


def test_a_label_without_any_pair_is_an_error_even_with_at_most(tmp_path: Path) -> None:
    source = pose_source((30,), PoseRule(negatives="cross_sequence"))
    with pytest.raises(InputError, match="it has no negative pair at all"):
        build(source, Plan({"train": 20}, at_most=True), tmp_path)


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        (Plan({"train": 7}), "even, not 7"),
        (Plan({"train": 0}), "no pairs are asked for"),
        (Plan({"train": 2}, seed=-1), "seed"),
        (Plan({"train": 2, "val": 2}, shares={"train": 1.0, "val": 0.0, "test": 0.0}), "share of val is 0"),
    ],
)
def test_invalid_numbers_are_refused(tmp_path: Path, plan: Plan, words: str) -> None:
    with pytest.raises(InputError, match=words):
        build(pose_source(), plan, tmp_path)


@pytest.mark.slow
def test_sampling_finds_the_same_pairs_as_enumeration(monkeypatch: pytest.MonkeyPatch) -> None:
    source = pose_source()
    images = everything(source)
    everything_there = find_pairs(source, images, {POSITIVE: 10**6, NEGATIVE: 10**6}, np.random.default_rng(0))
    monkeypatch.setattr(pairs_room, "ALL_PAIRS", 100)
    monkeypatch.setattr(pairs_room, "DRAWN_AT_ONCE", 512)
    drawn = find_pairs(source, images, {POSITIVE: 300, NEGATIVE: 300}, np.random.default_rng(0))
    for label in (POSITIVE, NEGATIVE):
        assert len(as_sets(drawn[label])) == len(drawn[label]) == 300
        assert as_sets(drawn[label]) <= as_sets(everything_there[label])
    # More than there are: drawing gives up, and the count is exact.
    exhausted = find_pairs(source, images, {POSITIVE: 10**6}, np.random.default_rng(0))
    assert as_sets(exhausted[POSITIVE]) == as_sets(everything_there[POSITIVE])

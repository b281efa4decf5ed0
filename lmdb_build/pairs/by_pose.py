"""A source of pairs from sequences with poses: the paper's rule, and which sequences show the same scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lmdb_build.pairs.choose import LEFT_OUT, NEGATIVE, POSITIVE, Indices, PairSource
from loopclosure.errors import InputError
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.same_place import (
    MAX_ANGLE_DEG,
    MAX_DISTANCE_M,
    angles_deg,
    distances_m,
    same_place,
    view_angles_deg,
)

# The relations of two sequences.
SAME_SEQUENCE, ONE_FRAME, ONE_SCENE, OTHER_SCENE = range(4)
NEGATIVES = ("same_sequence", "cross_sequence", "both")

NEIGHBOR_S = 3.0  # images within this time are neighbors, not two visits to a place
NEAR_FACTOR = 2.0  # negative pairs within this factor of the rule's limits look almost like positives
TOO_MANY = 0.2  # share of such pairs that causes a warning


@dataclass(frozen=True)
class PoseRule:
    """The rule for labeling pairs with poses; the defaults are the paper's.

    max_distance_m, max_angle_deg  a pair is positive if both distance and rotation are below these limits
    min_gap_s          pairs of one sequence with a smaller time difference are left out
    negatives          pairs used as negatives: ``same_sequence``, ``cross_sequence`` or ``both``
    clear_distance_m, clear_view_angle_deg  if given, a pair in one frame of reference is negative only if its distance
                       or the angle between its viewing axes is at least this; pairs that are neither positive nor
                       negative are left out
    """

    max_distance_m: float = MAX_DISTANCE_M
    max_angle_deg: float = MAX_ANGLE_DEG
    min_gap_s: float = 0.0
    negatives: str = "both"
    clear_distance_m: float | None = None
    clear_view_angle_deg: float | None = None


@dataclass(frozen=True)
class Scenes:
    """Which sequences show the same scene, by their names.

    same_scene   sets of sequences of one scene without a common frame of reference: pairs across them are left out
    same_frame   sets of sequences of one scene with a common frame of reference: pairs across them are labeled by pose
    all_others_differ  all other sequences show different scenes; without it, there is a warning
    """

    same_scene: tuple[tuple[str, ...], ...] = ()
    same_frame: tuple[tuple[str, ...], ...] = ()
    all_others_differ: bool = False

    def relations(self, names: Sequence[str]) -> NDArray[np.int8]:
        """Return the relation of each two sequences, (S, S). Raises InputError for an unknown name."""
        table = np.full((len(names), len(names)), OTHER_SCENE, np.int8)
        for sets, relation in ((self.same_scene, ONE_SCENE), (self.same_frame, ONE_FRAME)):
            for members in sets:
                for name in members:
                    if name not in names:
                        raise InputError(f'no sequence has the name "{name}"; there are: {", ".join(names)}')
                at = [names.index(name) for name in members]
                table[np.ix_(at, at)] = relation
        np.fill_diagonal(table, SAME_SEQUENCE)
        return table


class PoseSource(PairSource):
    """Pairs of images from sequences with poses, labeled by a :class:`PoseRule`."""

    group_word = "sequence"

    def __init__(
        self,
        sequences: Sequence[ImageSequence],
        folders: Sequence[str],
        rule: PoseRule = PoseRule(),
        scenes: Scenes = Scenes(),
    ) -> None:
        """Take the frames of all sequences.

        sequences  frames that all have a pose; frames without stamps get their numbers as stamps
        folders    the sequences' folders, relative to the list's root
        """
        self.group_names = [sequence.name for sequence in sequences]
        for name in self.group_names:
            if self.group_names.count(name) > 1:
                raise InputError(f'two sequences have the name "{name}"; rename one of the folders')
        self.names = [
            f"{folder}/{name}" if folder not in ("", ".") else name
            for folder, sequence in zip(folders, sequences, strict=True)
            for name in sequence.names
        ]
        self.groups = self.tracks = np.repeat(np.arange(len(sequences)), [len(sequence) for sequence in sequences])
        self.stamps = np.concatenate([_times(sequence) for sequence in sequences])
        self.poses = np.concatenate([sequence.known_poses() for sequence in sequences])
        self.rule, self.scenes = rule, scenes
        self._relations = scenes.relations(self.group_names)
        clear = []
        if rule.clear_distance_m is not None:
            clear.append(f"{rule.clear_distance_m:g} m apart or more")
        if rule.clear_view_angle_deg is not None:
            clear.append(f"viewing axes {rule.clear_view_angle_deg:g} deg apart or more")
        self.settings = {
            "source": f"poses of {', '.join(self.group_names)}",
            "positive": f"less than {rule.max_distance_m:g} m and less than {rule.max_angle_deg:g} deg apart",
            "negative": f"{' or '.join(clear) or 'the others'}; {rule.negatives}",
            "least time gap": f"{rule.min_gap_s:g} s",
        }
        for relation, sets in (("one scene", scenes.same_scene), ("one frame of reference", scenes.same_frame)):
            if sets:
                self.settings[relation] = "; ".join(" ".join(members) for members in sets)

    def judge(self, first: Indices, second: Indices) -> NDArray[np.int8]:
        """Label pairs (N,) by the rule."""
        rule = self.rule
        relation = self._relations[self.groups[first], self.groups[second]]
        a, b = self.poses[first], self.poses[second]
        comparable = relation <= ONE_FRAME
        same = same_place(a, b, rule.max_distance_m, rule.max_angle_deg)
        different = ~same
        if rule.clear_distance_m is not None or rule.clear_view_angle_deg is not None:
            clear = np.zeros(len(first), bool)
            if rule.clear_distance_m is not None:
                clear |= distances_m(a, b) >= rule.clear_distance_m
            if rule.clear_view_angle_deg is not None:
                clear |= view_angles_deg(a, b) >= rule.clear_view_angle_deg
            different &= clear
        wanted_origin = (relation == SAME_SEQUENCE) if rule.negatives == "same_sequence" else relation > SAME_SEQUENCE
        if rule.negatives == "both":
            wanted_origin = np.ones(len(first), bool)
        labels = np.full(len(first), LEFT_OUT, np.int8)
        labels[comparable & same] = POSITIVE
        labels[((comparable & different) | (relation == OTHER_SCENE)) & wanted_origin] = NEGATIVE
        neighbors = np.abs(self.stamps[first] - self.stamps[second]) < rule.min_gap_s
        labels[(relation == SAME_SEQUENCE) & neighbors] = LEFT_OUT
        return labels

    def measures(self, first: Indices, second: Indices) -> dict[str, NDArray[np.float64]]:
        """Distance and angle if the poses can be compared, time gap within a sequence."""
        relation = self._relations[self.groups[first], self.groups[second]]
        a, b = self.poses[first], self.poses[second]
        comparable = relation <= ONE_FRAME
        return {
            "distance [m]": np.where(comparable, distances_m(a, b), np.nan),
            "angle [deg]": np.where(comparable, angles_deg(a, b), np.nan),
            "time gap [s]": np.where(
                relation == SAME_SEQUENCE, np.abs(self.stamps[first] - self.stamps[second]), np.nan
            ),
        }

    def warnings(self, first: Indices, second: Indices, labels: NDArray) -> list[str]:
        """Return warnings about labels: undeclared scenes, neighbors as positives, negatives near the limits."""
        found = []
        relation = self._relations[self.groups[first], self.groups[second]]
        across = (labels == NEGATIVE) & (relation == OTHER_SCENE)
        if across.any() and not self.scenes.all_others_differ:
            found.append(
                f"{across.sum()} negatives are of different sequences that are not declared to show different scenes; "
                "if they show one room (as all of TUM's freiburg1 do), these labels are wrong: use --same-scene or "
                "--same-frame, or --different-scenes if all scenes differ"
            )
        measures = self.measures(first, second)
        neighbors = np.mean(measures["time gap [s]"][labels == POSITIVE] < NEIGHBOR_S) if POSITIVE in labels else 0.0
        if neighbors > 0.5:
            found.append(
                f"{neighbors:.0%} of the positives are images less than {NEIGHBOR_S:g} s apart, not two visits to a "
                "place: --min-gap sets a minimum"
            )
        negative = (labels == NEGATIVE) & (relation <= ONE_FRAME)
        near = (
            (measures["distance [m]"] < NEAR_FACTOR * self.rule.max_distance_m)
            & (measures["angle [deg]"] < NEAR_FACTOR * self.rule.max_angle_deg)
            & negative
        )
        if negative.any() and near.sum() > TOO_MANY * negative.sum():
            found.append(
                f"{near.sum() / negative.sum():.0%} of the negatives judged by pose are within twice the limits of the "
                "rule and show nearly the same: --clear-view-angle or --clear-distance leaves such pairs out"
            )
        return found


def _times(sequence: ImageSequence) -> NDArray[np.float64]:
    if sequence.stamps is not None:
        return sequence.stamps
    return np.arange(len(sequence), dtype=np.float64) if sequence.numbers is None else sequence.numbers.astype(float)

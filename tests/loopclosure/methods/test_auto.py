"""Loops without settings: what sequences, decoys and verification decide, on drives whose truth is known."""

import re
import tracemalloc
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from loopclosure.descriptors.feature_file import Features
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.images import ImageDecision
from loopclosure.detector.run import verdicts_said
from loopclosure.detector.verification import Agreement, Between, GeometricCheck, Pairs
from loopclosure.errors import InputError
from loopclosure.lines.chance import threshold
from loopclosure.lines.course import Course
from loopclosure.methods import drive as whole
from loopclosure.methods import lines
from loopclosure.methods.auto import answer, find_matches, places
from loopclosure.methods.base import Images, MethodContext, MethodResult
from loopclosure.methods.candidates import Candidates, Compared, candidates, far_apart, moved
from loopclosure.methods.contradiction import Visits
from loopclosure.methods.decision import between, fallen, neighbors
from loopclosure.methods.decoys import floor_age
from loopclosure.methods.geometry import Geometry, Matches
from loopclosure.methods.named import make_method
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.progress import silent

SIZE = 64


def drive(frames, seed):
    """Descriptors (frames, 64) of length 1 that change slowly: neighbors are alike."""
    steps = np.random.default_rng(seed).normal(size=(frames + 6, SIZE))
    rows = sum(steps[k : k + frames] for k in range(6))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def again(rows, noise, seed):
    """The same places in other weather."""
    seen = rows + noise / np.sqrt(SIZE) * np.random.default_rng(seed).normal(size=rows.shape)
    return seen / np.linalg.norm(seen, axis=1, keepdims=True)


def alike(a, b):
    return a @ b.T


def everything(scores):
    return np.ones(scores.shape, bool)


@pytest.mark.slow
def test_two_traverses_of_one_road_are_matched():
    road = drive(150, 0)
    scores = alike(again(road, 1.5, 50), road)
    found = answer(find_matches(Compared(scores, everything(scores), True)))
    assert np.count_nonzero(found.accepted) > 0.9 * 150
    assert np.all(np.abs(found.match - np.arange(150))[found.accepted] <= 3)
    assert len(found.reasons) == 3
    assert found.reasons[0].startswith("sequences of ")
    assert "accepted" in verdicts_said(found.results)
    assert "best score" in verdicts_said(found.results)


@pytest.mark.slow
def test_roads_without_common_places_have_no_loops():
    scores = alike(drive(150, 0), drive(120, 100))
    found = answer(find_matches(Compared(scores, everything(scores), True)))
    assert not found.accepted.any()
    assert "none is accepted" in found.reasons[2]
    assert verdicts_said(found.results).startswith("frames: 150 below threshold; best score ")


def test_a_drive_against_keyframes():
    road = drive(200, 1)
    scores = alike(again(road, 1.0, 2), road[::4])
    found = answer(find_matches(Compared(scores, everything(scores), True)))
    assert np.count_nonzero(found.accepted) > 0.9 * 200
    assert np.all(np.abs(4 * found.match - np.arange(200))[found.accepted] <= 8)


@pytest.mark.slow
def test_one_drive_with_one_revisit():
    road = drive(400, 3)
    rows = np.concatenate([road, again(road[100:180], 1.0, 4), drive(100, 5)])
    scores = alike(rows, rows)
    allowed = np.tri(len(rows), k=-31, dtype=bool)
    found = answer(find_matches(Compared(scores, allowed, False)))
    loops = np.zeros(len(rows), bool)
    loops[400:480] = True
    assert np.count_nonzero(found.accepted & loops) > 0.8 * 80
    right = np.abs(found.match - np.arange(len(rows)) + 300) <= 5
    assert right[found.accepted].all()


@pytest.mark.parametrize(("after", "seed"), [(0, 1), (40, 0)])
def test_frames_around_a_loop_are_not_part_of_it(after, seed):
    """Their distances hardly differ. Standardized as those of a loop, they would look like lines."""
    steps, other = (np.random.default_rng(number).random((126, 768)) for number in (seed, seed + 50))
    road, elsewhere = (np.sum([of[k : k + 120] for k in range(6)], axis=0) for of in (steps, other))
    rows = np.concatenate([road, 0.8 * road[20:100], elsewhere[:after]])
    scores = -np.linalg.norm(rows[:, None] - rows, axis=2)
    found = answer(find_matches(Compared(scores, np.tri(len(rows), k=-1, dtype=bool), False)))
    loops = np.flatnonzero(found.accepted)
    assert len(loops) > 75
    assert np.all((loops >= 120) & (loops < 200))
    assert np.all(np.abs(found.match[loops] - loops + 100) <= 2)


@pytest.mark.parametrize("frames", [1, 2, 12])
def test_too_few_frames_give_no_decision(frames):
    scores = alike(drive(frames, 1), drive(frames, 1))
    assert not answer(find_matches(Compared(scores, everything(scores), True))).accepted.any()


@pytest.mark.parametrize("kind", ["none", "half", "all"])
def test_a_long_sequence_counts_if_any_part_is_verified(kind):
    """Half of it may be in another light; in each of 40 unlike pairs something may be the same."""
    road = drive(150, 6)
    scores = alike(again(road, 1.0, 7), road)
    good, bad = Agreement(60, 50, 20), Agreement(40, 9, 20)

    def agree(query, reference):
        same = query < 75 and abs(query - reference) <= 3
        return good if kind == "all" or (kind == "half" and same) else bad

    found = answer(find_matches(Compared(scores, everything(scores), True)), GeometricCheck(), agree)
    assert np.count_nonzero(found.accepted) > 0.9 * 150
    assert f"{40 * (kind == 'all')} of 40 unlike pairs show the same points" in found.reasons[1]
    assert ("only 0 of 150 accepted matches" in " ".join(found.reasons)) == (kind == "none")


@pytest.mark.parametrize(
    "elsewhere",
    [
        lambda q, r, most_alike: 9,
        lambda q, r, most_alike: 24 * ((q + r) % 5 == 0),  # a hood, in a fifth of unlike pairs as well
        lambda q, r, most_alike: 36 * (r == most_alike),  # a curb with stripes, on another road than unlike pairs
    ],
)
def test_a_loop_ends_soon_after_its_last_verified_match(elsewhere):
    """The line through a loop goes on where the loop has ended."""
    road = drive(150, 6)
    rows = np.concatenate([road, again(road[:90], 1.0, 7), drive(60, 16)])
    scores = alike(rows, rows)
    best = np.where(np.tri(300, k=-31, dtype=bool), scores, -1).argmax(axis=1)

    def agree(q, r):
        one_place = abs(q - r) <= 3 or (150 <= q < 240 and abs(q - r - 150) <= 3)
        return Agreement(60, 50 if one_place else elsewhere(q, r, best[q]), 20)

    compared = Compared(scores, np.tri(300, k=-31, dtype=bool), False)
    found = answer(find_matches(compared), GeometricCheck(), agree)
    assert np.count_nonzero(found.accepted[150:240]) > 80
    assert not found.accepted[242:].any()


def on_one_line(match, verified, tried=None):
    """Matches that are all loops by their lines."""
    tried = np.ones(len(match), bool) if tried is None else tried
    nothing, points = np.zeros(len(match), bool), np.where(tried, 50 * verified, -1)
    return Matches(match, np.ones(len(match)), match >= 0, points, 2.0 * verified, ~nothing, nothing)


def spoken_against(matches, length, in_a_visit):
    """Which of the loops points speak against, if every ``in_a_visit``-th pair of frames of one visit is verified."""
    pairs, scores = neighbors(matches.match, Course(length)), np.zeros((len(matches.match), 200))
    visits = Visits(np.zeros((len(matches.match), 1)), lambda a, b: a % in_a_visit == 0, (0, 40))
    return fallen(matches.line, matches, pairs, length, scores, visits)


@pytest.mark.parametrize("start", [40, 65])
def test_the_end_of_a_line_counts_only_if_its_points_may_have_been_missed(start):
    """Up to there each match, or each third, is verified; after it none, for no more than the length of a line."""
    match = np.arange(70)
    thirds = (match % 3 == 0) & (match < start)
    assert spoken_against(on_one_line(match, thirds), 30, 3).any() == (start == 40)
    assert np.array_equal(spoken_against(on_one_line(match, match < start), 30, 1), match >= start)
    assert not spoken_against(on_one_line(match, match < start), 4, 1).any(), "several lines tell enough"


def test_a_short_line_without_a_verified_match_counts_only_where_few_are():
    match = np.concatenate([np.arange(40), np.full(20, -1), 100 + np.arange(8)])
    numbers = np.arange(68)
    assert np.array_equal(spoken_against(on_one_line(match, numbers < 40), 10, 1), numbers >= 60)
    assert not spoken_against(on_one_line(match, (numbers < 40) & (numbers % 8 == 0)), 10, 8)[60:].any()
    untried = on_one_line(match, numbers < 40, numbers < 60)
    assert not spoken_against(untried, 10, 1).any(), "none of the eight was tried"


@pytest.mark.parametrize("jump", [0, 60])
def test_between_two_loops_of_one_line_matches_are_loops_if_they_are_on_it(jump):
    """Others of the gap are not, nor is any where the loops are on two lines."""
    numbers, match = np.arange(60), np.arange(60) + jump * (np.arange(60) >= 40)
    loops = (numbers < 20) | (numbers >= 40)
    match[20:40] = np.where(np.arange(20) % 5 < 2, numbers[20:40] + 3, 500)
    assert np.array_equal(between(loops, match, Course(10)), ~loops & (match < 500) & (jump == 0))


def test_stops_of_both_traverses_are_matched_frame_by_frame():
    """A tunnel of 20 frames that look the same. By these one traverse enters it a frame before the other."""
    queries, references = np.r_[:12, 31:40], np.r_[:11, 30:40]
    rows = np.searchsorted(queries, np.arange(40), side="right") - 1
    given = Candidates(np.eye(21), np.ones((21, 21), bool), True, queries, references, rows)
    match, loops = np.arange(21), np.ones(21, bool)
    matches = Matches(match, np.ones(21), loops, np.full(21, -1), np.zeros(21), *np.zeros((2, 21), bool))
    assert np.array_equal(places(given, matches, loops), np.arange(40))
    loops[11] = False
    assert places(given, matches, loops)[11] == 30


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize(
    ("frames", "first", "last", "step"), [(600, 200, 400, 1), (400, 100, 160, 1), (600, 100, 500, 2)]
)
def test_a_part_of_a_route_is_found_at_any_speed_and_in_both_directions(frames, first, last, step, backwards):
    road = drive(frames, 1)
    where = np.arange(first, last, step)[:: -1 if backwards else 1]
    scores = alike(again(road[where], 1.0, 2), road)
    found = answer(find_matches(Compared(scores, everything(scores), True)))
    assert np.count_nonzero(found.accepted) > 0.9 * len(where)
    assert np.all(np.abs(found.match - where)[found.accepted] <= 3)
    assert ("backwards" in found.reasons[0]) == backwards


def test_the_way_back_is_found_in_one_drive():
    road = drive(150, 3)
    rows = np.concatenate([road, drive(40, 4), again(road[::-1], 1.0, 5)])
    found = answer(find_matches(Compared(alike(rows, rows), np.tri(len(rows), k=-11, dtype=bool), False)))
    assert np.count_nonzero(found.accepted[190:]) > 135
    assert np.count_nonzero(found.accepted[:190]) <= 1
    assert np.all(np.abs(found.match - (339 - np.arange(340)))[found.accepted] <= 3)


@pytest.mark.parametrize("seen", ["the same", "no points", "another place", "in part"])
def test_the_points_of_a_stretch_may_speak_against_it(seen):
    """A house in which a walk through more rooms looks like a second lap through the first ones."""
    road = drive(150, 6)
    rows = np.concatenate([road, again(road, 1.0, 7)])
    few = Agreement(40, 9, 20)

    def agree(a, b):
        if abs(a - b) < 100:  # one visit
            return few if seen == "no points" else Agreement(60, 50, 20) if abs(a - b) < 10 else few
        return {"the same": Agreement(60, 50, 20), "in part": Agreement(60, 36, 20)}.get(seen, few) if a % 3 else few

    found = answer(
        find_matches(Compared(alike(rows, rows), np.tri(300, k=-31, dtype=bool), False)), GeometricCheck(), agree
    )
    right = np.abs(found.match - np.arange(300) + 150) <= 3
    if seen in ("the same", "no points"):
        assert np.count_nonzero(found.accepted & right) > 130
        assert found.results[200].reason.startswith("sequence: ")
    else:
        assert not found.accepted.any()
        assert "because their points speak against them" in " ".join(found.reasons)
        assert "the points of its stretch speak against it" in found.results[200].reason


def test_where_a_quarter_of_the_matches_agrees_only_in_part_places_look_alike():
    """The floors of a tower have the same doors and signs, but not the same posters."""
    rng = np.random.default_rng(8)
    seen = rng.integers(0, 5, 200)
    rows = again(drive(5, 9)[seen], 0.3, 10)
    compared = Compared(alike(rows, rows), np.tri(200, k=-6, dtype=bool), False)
    for share in (0.65, 0.85):
        whole = rng.random((200, 200)) < share
        found = answer(
            find_matches(compared),
            GeometricCheck(),
            lambda a, b, whole=whole: Agreement(60, 48 if whole[a, b] else 36, 20 if seen[a] == seen[b] else 99),
        )
        assert bool(found.accepted.any()) == (share > 0.75)
        said = [reason for reason in found.reasons if "places look alike" in reason]
        assert len(said) == (share < 0.75)


def test_one_repeated_image_does_not_override_a_sequence():
    """The lamps of a tunnel: each third image is verified with the next lamp, which it looks like most."""
    road = drive(150, 6)
    scores = alike(again(road, 1.0, 7), road)
    lamps = np.arange(60, 90, 3)
    scores[lamps, lamps + 6] = 1
    good, bad = Agreement(60, 50, 20), Agreement(40, 9, 20)
    found = answer(
        find_matches(Compared(scores, everything(scores), True)),
        GeometricCheck(),
        lambda q, r: good if r - q == 6 * (q in lamps) else bad,
    )
    assert np.all(np.abs(found.match - np.arange(150))[found.accepted] <= 3)
    assert np.count_nonzero(found.accepted[60:90]) > 25


@pytest.mark.parametrize("inliers", [20, 28])
def test_a_repetitive_facade_is_not_a_loop(inliers):
    scores = alike(drive(150, 1), drive(120, 101))
    found = answer(
        find_matches(Compared(scores, everything(scores), True)),
        GeometricCheck(),
        lambda q, r: Agreement(40, inliers * (q % 2), 20),
    )
    assert not found.accepted.any()


def test_loops_on_a_desk_need_three_times_the_points_of_unlike_pairs():
    """Unlike pairs are verified as well; what has three times the points is a loop."""
    rng = np.random.default_rng(3)
    rows = again(drive(5, 9)[rng.integers(0, 5, 200)], 0.3, 10)
    found = answer(
        find_matches(Compared(alike(rows, rows), np.tri(200, k=-6, dtype=bool), False)),
        GeometricCheck(),
        lambda q, r: Agreement(90, 70 if rows[q] @ rows[r] > 0.7 else 25, 20),
    )
    assert "40 of 40 unlike pairs" in found.reasons[3]
    alike_ones = rows[np.arange(200)] @ rows.T > 0.7
    assert alike_ones[np.arange(200), found.match][found.accepted].all()
    assert np.count_nonzero(found.accepted) > 150


@pytest.mark.slow
def test_points_fixed_in_one_traverse_are_ignored():
    """A hood that the sun lights in the second pass; the least alike frames of it are those of the first."""
    rng, passes = np.random.default_rng(4), np.arange(80) // 40
    images = [cv2.resize(rng.integers(0, 256, (15, 20)).astype(np.uint8), (160, 120)) for _ in passes]
    hood = cv2.resize(rng.integers(0, 256, (8, 40)).astype(np.uint8), (160, 32), interpolation=cv2.INTER_CUBIC)
    for image in images[40:]:
        image[:32] = hood
    scores = rng.random((80, 80)) + (passes[:, None] == passes)
    given = candidates(Compared(scores, np.ones((80, 80), bool), False, visit=10))
    check = GeometricCheck()
    agree = Between(check, Pairs(lambda number: images[number]), range(80), range(80))
    assert 0.2 < Geometry.of(given, check, agree, given.there).hidden < 0.4


@pytest.mark.slow
def test_a_camera_that_moves_slowly_closes_no_loop():
    """Frames 31 apart are alike, and so are the next ones: a line, forwards only."""
    steps = np.random.default_rng(4).normal(size=(500, SIZE))
    rows = np.cumsum(steps, axis=0)
    rows = rows[100:] - rows[:-100]
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    assert not answer(find_matches(Compared(alike(rows, rows), np.tri(400, k=-31, dtype=bool), False))).accepted.any()


@pytest.mark.slow
def test_a_second_pass_with_an_offset_is_found_from_consecutive_frames():
    road = drive(400, 3)
    rows = np.concatenate([road, again(road[100:180], 1.0, 4), drive(100, 5)])
    points = Agreement(80, 60, 20), Agreement(80, 9, 20)
    found = answer(
        find_matches(Compared(alike(rows, rows), np.tri(len(rows), k=-31, dtype=bool), False)),
        GeometricCheck(),
        lambda q, r: points[q - r != 1],
    )
    assert np.count_nonzero(found.accepted) > 60


@pytest.mark.parametrize("length", [4, 12, 40])
def test_a_visit_of_a_place_ends(length):
    """A room in which a camera turns: everything is seen again and again, and is alike."""
    visits = np.arange(480) // length
    views = again(np.tile(drive(1, 1), (8, 1)), 0.8, 2)[visits % 8]
    scores, earlier = alike(*[again(views, 0.3, 3)] * 2), np.tri(480, k=-1, dtype=bool)
    given = candidates(Compared(scores, earlier, False))
    visits = visits[given.queries]
    apart = np.subtract.outer(visits, visits)
    assert np.mean(given.allowed[(apart > 0) & (apart % 8 == 0)]) > 0.95
    assert not given.allowed[apart == 0].any()
    assert int(given.said.split()[6]) <= 3 * length
    said = candidates(Compared(scores, earlier, False, visit=7))
    assert np.array_equal(said.allowed, np.subtract.outer(said.queries, said.queries) > 7)


@pytest.mark.parametrize("stands", ["query", "reference"])
@pytest.mark.parametrize(("times", "noise"), [(40, 0.03), (150, 0.1)])
def test_a_stopped_robot_adds_no_frames_to_a_sequence(stands, times, noise):
    road = drive(150, 6)
    places = np.repeat(np.arange(150), np.where(np.isin(np.arange(150), (30, 90)), times, 1))
    still, moving = again(again(road, 0.8, 7)[places], noise, 8), np.arange(150)
    there, here = (places, moving) if stands == "query" else (moving, places)
    scores = alike(still, road) if stands == "query" else alike(road, still)
    found = answer(find_matches(Compared(scores, everything(scores), True)))
    assert np.count_nonzero(found.accepted) > 0.95 * len(there)
    assert np.all(np.abs(here[found.match] - there)[found.accepted] <= 1)


def test_a_slow_robot_is_not_stopped():
    road = drive(200, 6)
    places = np.cumsum(np.where(np.isin(np.arange(200) // 40, (1, 3)), 0.4, 1))
    left, part = np.floor(places).astype(int), (places % 1)[:, None]
    scores = alike((1 - part) * road[left] + part * road[left + 1], road)
    assert np.array_equal(moved(scores), np.arange(200))


def test_a_loop_does_not_cross_a_cut():
    """The second pass begins where the first one did, and not where it ended."""
    road = drive(150, 6)
    rows = np.concatenate([road, again(road, 0.8, 7)])
    found = answer(find_matches(Compared(alike(rows, rows), np.tri(300, k=-11, dtype=bool), False)))
    assert np.count_nonzero(found.accepted[150:]) > 130
    assert np.count_nonzero(found.accepted[:150]) <= 1
    assert np.all(np.abs(found.match - np.arange(300) + 150)[found.accepted] <= 3)


def round_and_round(frames, radius=20.0):
    """Odometry of laps of 100 frames; it drifts outwards, by 2 % of the way."""
    angle = 2 * np.pi * np.arange(frames) / 100
    poses = np.zeros((frames, 7))
    poses[:, :2] = (radius + 0.02 * radius * angle)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    poses[:, 6] = 1
    return poses


def test_odometry_distinguishes_places():
    far = far_apart(round_and_round(300))
    lag = np.abs(np.subtract.outer(np.arange(300), np.arange(300)))
    assert not far[lag % 100 <= 2].any()
    assert far[lag == 50].all()
    assert not far_apart(np.full((5, 7), np.nan)).any()


def test_odometry_of_a_long_drive_needs_little_more_memory_than_its_result():
    poses = round_and_round(1500)
    tracemalloc.start()
    far = far_apart(poses)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 14 * far.size


@pytest.mark.slow
def test_with_odometry_single_images_are_distinguished_from_chance():
    """The camera looks where it likes, so that no sequence comes back; a twin of each place is across the road."""
    rng = np.random.default_rng(2)
    places = drive(100, 1)[rng.permutation(100)]
    places[50:] = again(places[:50], 1.0, 2)
    rows = np.concatenate([again(places, 0.5, 3), places])
    scores, allowed = alike(rows, rows), np.tri(200, k=-6, dtype=bool)
    far = far_apart(round_and_round(200))
    found = answer(find_matches(Compared(scores, allowed, False, far)))
    wrong = np.abs(found.match - np.arange(200) + 100) > 2
    assert "far apart in the odometry" in found.reasons[2]
    assert np.count_nonzero(found.accepted) > 50
    assert not (found.accepted & wrong).any()


def test_single_images_are_verified_if_sequences_are_inconclusive():
    """A camera that looks at five things in random order."""
    rng = np.random.default_rng(8)
    seen = rng.integers(0, 5, 200)
    rows = again(drive(5, 9)[seen], 0.3, 10)
    scores = alike(rows, rows)
    points = Agreement(60, 50, 20), Agreement(3, 0, 20)
    found = answer(
        find_matches(Compared(scores, np.tri(200, k=-6, dtype=bool), False)),
        GeometricCheck(),
        lambda a, b: points[0] if seen[a] == seen[b] and a % 10 else points[1],
    )
    assert "one by one" in found.reasons[2]
    right = seen[found.match] == seen
    assert right[found.accepted].all()
    assert np.count_nonzero(found.accepted) > 150
    assert "cannot be" in found.reasons[3]


def test_frames_of_a_slow_drive_are_other_places_only_when_they_are_old():
    for slow in (10, 100):
        steps = np.random.default_rng(4).normal(size=(600 + slow, SIZE))
        rows = np.cumsum(steps, axis=0)
        rows = rows[slow:] - rows[:-slow]
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        assert 0.6 * slow <= floor_age(alike(rows, rows)) <= 1.2 * slow


def test_a_threshold_counts_decoys():
    rng = np.random.default_rng(0)
    wrong, decoys = rng.exponential(size=(2, 4000))
    targets = np.concatenate([wrong, 14 + rng.normal(size=1000)])
    level = threshold(targets, np.concatenate([decoys, rng.exponential(size=1000)]), 0.99)
    assert 4.0 < level < 9.0
    assert np.mean(wrong[wrong >= level] < 14) * np.count_nonzero(wrong >= level) <= 20
    assert threshold(wrong, decoys, 0.99) > np.sort(wrong)[-20]
    assert threshold(wrong, decoys[:3], 0.99) == np.inf


class Fixed:
    name = "fixed"

    def __init__(self, scores):
        self.scores = scores

    def score(self, images, progress):
        return MethodResult(self.scores)


def test_as_a_method(tmp_path, monkeypatch):
    road = drive(150, 11)
    scores = alike(again(road, 1.0, 12), road)
    method: Any = make_method("auto+thumbnails", MethodContext(), {"auto.precision": "0.9"})
    assert method.name == "auto+thumbnails"
    assert method.precision == 0.9
    method.inner = Fixed(scores)
    monkeypatch.setattr(type(method.pairs), "agreement", lambda *_: Agreement(0, 0, 20))
    monkeypatch.setattr(type(method.pairs), "without_fixed", lambda pairs, *_: pairs)
    paths = [tmp_path / f"{i}.png" for i in range(150)]
    result = method.score(Images.of_files(paths, paths), silent)
    assert np.count_nonzero(np.isfinite(result.scores)) > 0.9 * 150
    assert any(note.startswith("sequences of") for note in result.notes)
    assert result.answer.startswith("frames: ")


@pytest.mark.parametrize(
    ("spec", "settings", "message"),
    [("auto", {}, r"write auto\+METHOD"), ("auto+thumbnails", {"auto.length": "3"}, 'auto has no setting "length"')],
)
def test_invalid_settings_are_refused(spec, settings, message):
    with pytest.raises(InputError, match=message):
        make_method(spec, settings=settings)


def test_a_precision_that_makes_no_sense():
    with pytest.raises(InputError, match="precision is 2"):
        find_matches(Compared(np.eye(3), np.ones((3, 3), bool), True), precision=2.0)


def test_results_do_not_depend_on_blocks_of_queries(monkeypatch):
    road = drive(120, 5)
    scores = alike(again(road, 1.0, 6), road)
    at_once = answer(find_matches(Compared(scores, everything(scores), True)))
    monkeypatch.setattr(lines, "BLOCK", 7)
    assert answer(find_matches(Compared(scores, everything(scores), True))) == at_once
    assert np.count_nonzero(at_once.accepted) > 100


def test_every_second_frame_of_a_very_long_drive_decides(monkeypatch):
    road = drive(160, 7)
    rows = np.concatenate([road, again(drive(60, 8), 0, 9), again(road, 0.3, 10)])
    monkeypatch.setattr(whole, "MOST_PAIRS", len(rows) ** 2 // 2)
    detector, paths = LoopDetector(), [Path(f"{number}.png") for number in range(len(rows))]
    found = whole.whole_drive(
        detector, ImageSequence.of_files(paths), Features(Path("rows.npz"), rows.astype(np.float32))
    )
    assert "one of 2 is" in found.reasons[0]
    assert len(found.results) == len(rows)
    assert np.count_nonzero(found.accepted[220:]) > 120
    assert np.all(np.abs(found.match + 220 - np.arange(len(rows)))[found.accepted] <= 3)
    assert [result.query_id for result in found.results] == list(range(len(rows)))


def test_a_stored_drive_is_decided_once_and_gives_a_threshold(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is decided when a frame comes; the threshold is that of a detector that looks up frame by frame."""
    road = drive(80, 7)
    rows = np.concatenate([road, drive(60, 8), again(road, 0.3, 10)]).astype(np.float32)
    monkeypatch.setattr(ImageDecision, "decide", None)
    detector, paths = LoopDetector(exclude_recent=20), [Path(f"{number}.png") for number in range(len(rows))]
    found = whole.whole_drive(detector, ImageSequence.of_files(paths), Features(Path("rows.npz"), rows))
    assert len(detector.loops) == np.count_nonzero(found.accepted) > 60
    later = whole.later_threshold(detector, found.accepted)
    monkeypatch.undo()
    online = LoopDetector(exclude_recent=20, threshold=-np.inf)
    single = np.array([online.add_descriptor(row).score for row in rows])
    others = single[~found.accepted].max()
    assert later == pytest.approx(single[found.accepted & (single > others)].min(), rel=1e-4)


def test_the_advised_threshold_is_accepted_by_the_parser() -> None:
    """Where fewer frames have a candidate than are advised to be looked at, the threshold is one of theirs."""
    scores = np.random.default_rng(0).normal(size=(30, 30)) - 5
    allowed = np.zeros((30, 30), bool)
    allowed[:3] = True
    *_, total = answer(find_matches(Compared(scores, allowed, True))).reasons
    assert re.search(r"--threshold -\d+(\.\d+)? accepts", total), total

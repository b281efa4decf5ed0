"""The one decision: what sequences, decoys and points decide, at once and frame by frame, on drives of known truth."""

from dataclasses import replace

import numpy as np
import pytest

from given_scores import GivenScores
from loopclosure.decision.constants import ALIKE, PRECISION, SURE, SURE_AMONG_ALIKE
from loopclosure.decision.decider import Decider, Decision, Settings
from loopclosure.decision.lines import HALF
from loopclosure.decision.points import look_alike, too_few, wrong_share
from loopclosure.decision.trajectories import SequenceSettings, trajectory_costs
from loopclosure.decision.visits import Usual, Visits, far_apart, outstanding
from loopclosure.detector.verification import Agreement, GeometricCheck, LocalFeatures, Pairs
from loopclosure.errors import InputError
from loopclosure.methods.auto import Auto
from loopclosure.methods.base import Images
from loopclosure.methods.drive import USUAL, Drive, Request, speeds_between
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.progress import silent
from paths import shared

SIZE = 64
GOOD, BAD = Agreement(60, 55, 20), Agreement(20, 5, 15)


def drive(frames, seed):
    """Descriptors (frames, 64) of length 1 that change slowly: neighbors are alike."""
    steps = np.random.default_rng(seed).normal(size=(frames + 6, SIZE))
    rows = sum(steps[k : k + frames] for k in range(6))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def again(rows, noise, seed):
    """The same places in other weather."""
    seen = rows + noise / np.sqrt(SIZE) * np.random.default_rng(seed).normal(size=rows.shape)
    return seen / np.linalg.norm(seen, axis=1, keepdims=True)


def one_drive(rows, precision=PRECISION, agree=None, request=USUAL, scores=None):
    """Decide on one drive."""
    scores = rows @ rows.T if scores is None else scores
    path = Drive(
        len(rows),
        lambda part: (scores[part.start : part.stop],) * 2,
        0,
        lambda query: request.possible(query, np.zeros(len(rows))),
    )
    return path.decided(precision, None if agree is None else GeometricCheck(), agree, agree)[1]


def traverses(queries, references, agree=None, among=None):
    """Decide on two traverses."""
    path = Drive(
        len(queries),
        lambda part: (queries[part.start : part.stop] @ references.T, queries[part.start : part.stop] @ queries.T),
        None,
        speeds=speeds_between(len(queries), len(references)),
    )
    return path.decided(PRECISION, None if agree is None else GeometricCheck(), agree, among)[1]


def wrong(found: Decision, truth, near=3):
    """How many accepted matches are further than ``near`` references from the true ones."""
    return np.count_nonzero(found.loops & (np.abs(found.match - truth) > near))


ROAD = drive(150, 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("queries", "references", "truth", "least"),
    [
        pytest.param(again(ROAD, 1.5, 2), ROAD, np.arange(150), 135, id="one speed"),
        pytest.param(again(ROAD, 1.0, 2)[::-1], ROAD, np.arange(150)[::-1], 135, id="backwards"),
        pytest.param(again(ROAD, 1.0, 2)[::2], ROAD, np.arange(0, 150, 2), 60, id="twice as fast"),
        pytest.param(again(drive(300, 3), 1.0, 2)[90:140], drive(300, 3), np.arange(90, 140), 40, id="a part"),
        pytest.param(drive(150, 5), drive(120, 105), np.full(150, -99), 0, id="another road"),
    ],
)
def test_two_traverses_are_matched(queries, references, truth, least):
    found = traverses(queries, references)
    assert np.count_nonzero(found.loops) >= least
    assert wrong(found, truth) == 0


def revisit():
    """A drive of 400 frames, frames 100 to 180 of it again, and another 100."""
    road = drive(400, 3)
    return np.concatenate([road, again(road[100:180], 1.0, 4), drive(100, 5)])


@pytest.mark.slow
@pytest.mark.parametrize("known", ["all", "earlier frames"])
def test_one_drive_with_one_revisit(known):
    """Also by a method that scores earlier frames only."""
    rows = revisit()
    scores = rows @ rows.T
    if known != "all":
        scores = np.where(np.tri(len(rows), k=-1, dtype=bool), scores, np.nan)
    found = one_drive(rows, scores=scores)
    assert np.count_nonzero(found.loops[400:480]) > 60
    assert wrong(found, np.arange(len(rows)) - 300, 5) == 0
    assert found.by_line[found.loops].all()
    assert (found.wrong[found.loops] <= 1 - PRECISION).all()


def test_scores_of_sequences_make_no_loops_of_a_road_driven_once():
    """SeqSLAM smooths its scores in the direction of time, so that lines of this direction stand out everywhere."""
    rows = drive(200, 11)
    earlier = np.tri(len(rows), k=-1, dtype=bool)
    costs = trajectory_costs(np.where(earlier, -rows @ rows.T, np.nan), SequenceSettings(contrast=0))
    assert not one_drive(rows, scores=np.where(earlier, -costs, np.nan)).loops.any()


def test_a_loop_between_two_others_has_their_share_of_wrong_ones():
    """No sequence passes four other frames, whose matches are on the line through those around them."""
    queries = again(ROAD, 1.0, 2)
    queries[60:64] = drive(4, 9)
    found = traverses(queries, ROAD)
    assert found.loops[61]
    assert found.wrong[found.loops].max() <= 1 - PRECISION


@pytest.mark.parametrize("frames", [1, 2, 12])
def test_too_few_frames_give_no_decision(frames):
    assert not one_drive(drive(frames, 1)).loops.any()


@pytest.mark.parametrize("agreeing", [True, False], ids=["points agree", "no points"])
def test_points_speak_against_a_sequence(agreeing):
    """Frames of one visit agree in points; a sequence of which none does is none."""
    rows = revisit()

    def agree(query, other):
        same = abs(query - other) < 20 or (agreeing and 400 <= query < 480 and abs(query - other - 300) < 5)
        return GOOD if same else BAD

    found = one_drive(rows, agree=agree)
    assert (np.count_nonzero(found.loops) > 60) == agreeing
    assert found.fell.any() != agreeing


@pytest.mark.parametrize("precision", [0.1, 0.99, 0.9999999])
def test_a_higher_precision_accepts_no_more_images(precision):
    """30 of 80 places are seen again, in no order; with 2.5 times the points that chance explains."""
    road, rng = drive(80, 1), np.random.default_rng(3)
    back = rng.permutation(80)[:30]
    same = {(80 + i, int(k)) for i, k in enumerate(back)}
    rows = np.concatenate([road, again(road[back], 0.3, 2)])
    found = one_drive(rows, precision, lambda q, r: Agreement(60, 52, 20) if (q, r) in same else BAD, Request(recent=0))
    accepted = np.count_nonzero(found.loops)
    assert (accepted > 15) == (precision < 0.999)
    assert (found.wrong[found.loops] <= (1 - precision) * 1.01).all()


def test_the_share_of_wrong_images_falls_with_the_evidence():
    shares = wrong_share(np.array([SURE, SURE_AMONG_ALIKE]), alike=False)
    assert shares[0] == pytest.approx(1 - PRECISION)
    assert shares[1] < shares[0] / 50
    assert wrong_share(np.array([SURE_AMONG_ALIKE]), alike=True)[0] == pytest.approx(1 - PRECISION)


@pytest.mark.parametrize(("part", "many", "alike"), [(0, 0, True), (0, 2, False), (1, 6, False), (3, 12, True)])
def test_places_look_alike_until_matches_say_otherwise(part, many, alike):
    assert look_alike(part, many) == alike == (part + 1 > ALIKE * (many + 2))


def test_few_verified_matches_count_only_where_frames_of_one_visit_are_verified():
    assert too_few((0, 20), 1, (38, 40), (0, 40))
    assert not too_few((0, 20), 1, (0, 40), (0, 40))
    assert not too_few((12, 20), 1, (38, 40), (0, 40))


def streamed(scores, agree, usual=None):
    """Decide frame by frame, on each frame when ``HALF`` more are known: loops by query."""
    decider, found = Decider(Settings(), GeometricCheck(), agree, agree, usual), {}
    for query in range(len(scores)):
        decider.add(scores[query, :query], scores[query, :query], 0, Request().possible(query, scores[0]))
        decider.look(query)
        middle = query - HALF
        if middle >= 0:
            decider.lines.search(middle + 1)
            decision = decider.decide(0, middle + 1)
            if decision.loops[-1]:
                found[middle] = int(decision.match[-1])
    return found


def differ_only_by_the_delay(scores, agree):
    """A frame is decided online as it is in a recording that ends when it is decided."""
    found = streamed(scores, agree)
    ends = [*sorted(found)[:: max(1, len(found) // 6)], len(scores) // 2]
    for query in ends:
        decider = Decider(Settings(), GeometricCheck(), agree, agree)
        for number in range(min(len(scores), query + HALF + 1)):
            row = scores[number, :number]
            decider.add(row, row, 0, Request().possible(number, scores[0]))
            decider.look(number)
        decider.lines.search(query + 1)
        decision = decider.decide(0, query + 1)
        assert (int(decision.match[-1]) if decision.loops[-1] else None) == found.get(query)
    return found


@pytest.mark.slow
def test_frames_are_decided_online_as_in_a_recording_that_ends_then():
    rows = revisit()
    found = differ_only_by_the_delay(rows @ rows.T, lambda q, r: GOOD if abs(q - r) < 20 or q - r == 300 else BAD)
    assert sum(abs(match - query + 300) <= 5 for query, match in found.items()) == len(found) > 40


@pytest.mark.slow
def test_a_real_corridor_is_decided_online_as_in_a_recording_that_ends_then():
    from loopclosure.detector.describers import load_describe
    from loopclosure.detector.verification import Pairs
    from loopclosure.places.frames import image_paths, read_bgr, read_gray

    paths, describe = image_paths(shared("data", "corridor_loop", "samples")), load_describe("small")
    rows = np.array([np.ravel(describe(read_bgr(path))) for path in paths])
    scores, pairs = -np.linalg.norm(rows[:, None] - rows, axis=2), Pairs(read_gray)
    found = differ_only_by_the_delay(scores, lambda q, r: pairs.agreement(GeometricCheck(), paths[q], paths[r]))
    assert len(found) > 10


def test_frames_far_apart_by_odometry_are_no_candidates():
    poses = np.zeros((30, 7))
    poses[:, 0] = np.arange(30)
    poses[12] = np.nan
    far = far_apart(poses, 29)
    assert far[:12].all()
    assert not far[12]
    assert not far[25:].any()


def test_odometry_of_auto_is_interpolated(tmp_path):
    """Two laps are alike; by odometry of 5 Hz, with images between its poses, they are two floors."""
    rows = np.concatenate([drive(80, 3), again(drive(80, 3), 0.3, 4)])
    stamps = 0.2 * (np.arange(len(rows)) + 0.5)
    path = np.array([[0.2 * t, t, 0, 0, 0, 0, 0, 1] for t in range(len(rows) + 1)], float)
    np.savetxt(tmp_path / "odometry.txt", path)
    files = [tmp_path / f"{number}.png" for number in range(len(rows))]
    images = Images(replace(ImageSequence.of_files(files), stamps=stamps))
    pairs = Pairs(lambda path: LocalFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8)))
    counts = []
    for odometry in ("", str(tmp_path / "odometry.txt")):
        method = Auto(GivenScores(rows @ rows.T), odometry=odometry, pairs=pairs)
        counts.append(np.count_nonzero(np.isfinite(method.score(images, silent).scores)))
    assert counts[0] > 40
    assert counts[1] == 0


def test_visits_end_when_two_frames_in_a_row_differ():
    visits = Visits()
    for row in ([], [1], [1, 1], [0, 0, 0], [0, 0, 0, 1], [0, 0, 0, 1, 1]):
        left = visits.add(np.array(row, float), 0.5, least=0)
    assert left.tolist() == [True, False, False, False, False]
    usual = Usual()
    for row in (np.zeros(0), np.ones(1), np.array([0.0, 1.0])):
        usual.add(row)
    assert usual.score in (0.5, 1.0)
    assert usual.together >= 1


def test_what_stands_out_does_not_depend_on_light():
    scores = np.random.default_rng(0).normal(size=100)
    np.testing.assert_allclose(outstanding(scores), outstanding(3 * scores - 7), atol=1e-4)
    assert np.isnan(outstanding(np.full(5, np.nan))).all()


@pytest.mark.parametrize("precision", [0.0, 1.0, 2.0])
def test_an_impossible_precision_is_refused(precision):
    with pytest.raises(InputError, match="more than 0 and less than 1"):
        Settings(precision)

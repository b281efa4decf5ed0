"""Methods judged on a synthetic round trip, and how methods are named."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from given_scores import GivenScores
from loopclosure.errors import InputError
from loopclosure.evaluation import WIDE, evaluate
from loopclosure.methods.auto import Auto
from loopclosure.methods.base import MethodContext
from loopclosure.methods.features import FeatureMethod
from loopclosure.methods.named import METHODS, make_method, named_methods
from loopclosure.methods.seqslam import SeqSlam
from loopclosure.methods.verified import Verified
from loopclosure.places.datasets import load_sequence
from loopclosure.places.sequences import read_sequence
from loopclosure.precision_recall import ALL_PAIRS, BEST_MATCH


def test_perfect_features_find_every_loop(two_laps, two_laps_features):
    data = load_sequence(read_sequence(two_laps, "tum"))
    found = evaluate(data, named_methods([f"net=features:{two_laps_features}"]))
    (outcome,) = found.outcomes
    assert outcome.name == "net"
    assert outcome.pairs.average_precision == pytest.approx(1.0)
    assert outcome.best.recall_at_full_precision == 1.0
    assert outcome.best.positives == 20
    assert outcome.seconds["features"] == pytest.approx(40 * 0.004)
    assert found.image_count == 40
    assert outcome.measures[BEST_MATCH]["recall at 1"] == 1.0
    assert outcome.measures[ALL_PAIRS]["average precision"] == pytest.approx(1.0)


def test_queries_without_an_answer_reduce_recall(two_laps):
    data = load_sequence(read_sequence(two_laps, "tum"))
    scores = np.where(data.truth.hard, 1.0, 0.0)
    scores[30:] = np.nan
    (outcome,) = evaluate(data, [("half", GivenScores(scores, {"looking": 1.0}, ["a note"]))]).outcomes
    assert outcome.pairs.recall[0] == 0.5
    silent = int(np.count_nonzero(data.truth.judged[30:]))
    assert outcome.notes[-1].startswith(f"no score for {silent} of ")


def test_training_time_is_not_part_of_the_time_per_frame(two_laps):
    data = load_sequence(read_sequence(two_laps, "tum"))
    method = GivenScores(np.zeros((40, 40)), {"training": 2.0, "looking": 1.0}, [], ("training",))
    (outcome,) = evaluate(data, [("x", method)]).outcomes
    assert outcome.seconds_on_frames == 1.0


def test_scores_of_another_size_are_refused(two_laps):
    with pytest.raises(InputError, match="the scores are 3 x 3, the truth is 40 x 40"):
        evaluate(load_sequence(read_sequence(two_laps, "tum")), [("x", GivenScores(np.zeros((3, 3))))])


def test_two_methods_of_one_name_are_refused(two_laps):
    with pytest.raises(InputError, match='two methods are called "x"'):
        evaluate(
            load_sequence(read_sequence(two_laps, "tum")),
            [("x", GivenScores(np.zeros((40, 40)))), ("x", GivenScores(np.zeros((40, 40))))],
        )


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("features:a/siamese_8.npz", "siamese_8 (euclidean)"),
        ("features:a=b/c+d.npz", "c+d (euclidean)"),
        ("Siamese (8)=features:a.npz", "Siamese (8)"),
        ("a + b=thumbnails", "a + b"),
        ("thumbnails", "thumbnails"),
    ],
)
def test_labels(text, name):
    assert named_methods([text])[0][0] == name


def test_methods_can_refine_another():
    method = make_method("seqslam+features:a.npz", MethodContext(exclude_frames=7), {"features.metric": "cosine"})
    assert isinstance(method, SeqSlam)
    assert method.name == "seqslam+a (cosine)"
    assert method.inner == FeatureMethod(Path("a.npz"), Path("a.npz"), "cosine")
    assert method.exclude_frames == 7


def test_a_path_in_a_method_may_have_a_plus():
    for path in ("a+b/o.npz", "a+bow/o.npz"):
        method = make_method(f"auto+seqslam+features:{path}")
        assert isinstance(method, Auto)
        assert method.name == "auto+seqslam+o (euclidean)"
    with pytest.raises(InputError, match='unknown method "foo" in "foo:1"'):
        make_method("auto+foo:1")


def test_methods_can_refine_a_refining_method():
    settings = {"verified.k": "7", "verified.max_features": "90", "verified.ratio": "0.7", "seqslam.length": "6"}
    outer = make_method("verified+seqslam+features:a.npz", MethodContext(3), settings)
    assert isinstance(outer, Verified)
    assert (outer.k, outer.check.max_features, outer.check.ratio, outer.exclude_frames) == (7, 90, 0.7, 3)
    assert isinstance(outer.inner, SeqSlam)
    assert outer.inner.settings.length == 6
    assert outer.name == "verified+seqslam+a (euclidean)"
    assert isinstance(make_method("seqslam+verified+thumbnails"), SeqSlam)


def test_settings_of_a_method_and_of_a_label():
    settings = {"seqslam.length": "6", "long, v1.0.length": "20", "thumbnails.width": "16"}
    methods: Any = named_methods(["seqslam+thumbnails", "long, v1.0=seqslam+thumbnails"], settings=settings)
    assert [(name, method.settings.length, method.inner.thumbnailer.width) for name, method in methods] == [
        ("seqslam+thumbnails", 6, 16),
        ("long, v1.0", 20, 16),
    ]
    with pytest.raises(InputError, match='settings of "bow", which is none of the methods'):
        named_methods(["thumbnails"], settings={"bow.words": "9"})
    with pytest.raises(InputError, match=r"expected NAME\.setting=value"):
        named_methods(["thumbnails"], settings={"width": "9"})


def test_results_by_a_wider_angle(two_laps):
    """Neighboring places are 18 degrees apart, and 1.6 m: other places by 15 degrees, the same by 45."""
    data = load_sequence(read_sequence(two_laps, "tum"))
    neighbors = np.roll(data.truth.hard, 1, axis=1)
    (outcome,) = evaluate(data, [("x", GivenScores(neighbors.astype(float)))]).outcomes
    assert outcome.measures[BEST_MATCH]["recall at 100 % precision"] == 0
    assert outcome.measures[BEST_MATCH + WIDE]["recall at 100 % precision"] > 0.9
    assert outcome.wide is not None
    assert "turned less than 45 degrees" in outcome.wide.best.truth_description
    (alone,) = evaluate(replace(data, wide=None), [("x", GivenScores(neighbors.astype(float)))]).outcomes
    assert alone.wide is None
    assert BEST_MATCH + WIDE not in alone.measures


def test_a_method_that_accepts_nothing_scores_0(two_laps):
    (outcome,) = evaluate(
        load_sequence(read_sequence(two_laps, "tum")), [("x", GivenScores(np.full((40, 40), np.nan)))]
    ).outcomes
    assert {value for table in outcome.measures.values() for value in table.values()} == {0.0}


@pytest.mark.parametrize("spec", ["magic", "magic:a=1", "seqslam+magic", ""])
def test_unknown_methods_list_the_known(spec):
    with pytest.raises(InputError, match="known: fabmap, bow"):
        make_method(spec)


@pytest.mark.parametrize("name", METHODS)
def test_every_registered_name_exists(name):
    needed = {
        "features": ":a.npz",
        "describe": ":a.py:function",
        "verified": "+thumbnails",
        "auto": "+thumbnails",
    }
    assert make_method(name + needed.get(name, "")).name

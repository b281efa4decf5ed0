"""Methods judged on a synthetic round trip, and how methods are named."""

from pathlib import Path

import numpy as np
import pytest

from loopclosure.errors import InputError
from loopclosure.evaluate import evaluate, named_method
from loopclosure.methods.base import METHODS, MethodContext, MethodResult, make_method
from loopclosure.methods.features import FeatureMethod
from loopclosure.methods.seqslam import SeqSlam
from loopclosure.places.datasets import load_tum
from loopclosure.precision_recall import ALL_PAIRS, BEST_MATCH


class Says:
    """A method that returns given scores."""

    def __init__(self, scores, name="says", training_stages=()):
        self.scores, self.name, self.training_stages = scores, name, training_stages

    def score(self, images, progress):
        return MethodResult(self.scores, {"training": 2.0, "looking": 1.0}, ["a note"], self.training_stages)


def test_perfect_features_find_every_loop(two_laps, two_laps_features):
    data = load_tum(two_laps)
    found = evaluate(data, [named_method(f"net=features:{two_laps_features}", MethodContext())])
    (outcome,) = found.outcomes
    assert outcome.name == "net"
    assert outcome.pairs.average_precision == pytest.approx(1.0)
    assert outcome.best.recall_at_full_precision == 1.0
    assert outcome.best.positives == 20
    assert outcome.seconds["features"] == pytest.approx(40 * 0.004)
    assert found.image_count == 40
    assert outcome.measures[BEST_MATCH]["recall at 1"] == 1.0
    assert outcome.measures[ALL_PAIRS]["average precision"] == pytest.approx(1.0)


def test_silence_is_said_and_costs_recall(two_laps):
    data = load_tum(two_laps)
    scores = np.where(data.truth.hard, 1.0, 0.0)
    scores[30:] = np.nan
    (outcome,) = evaluate(data, [("half", Says(scores))]).outcomes
    assert outcome.pairs.recall[0] == 0.5
    silent = int(np.count_nonzero(data.truth.judged[30:]))
    assert outcome.notes[-1].startswith(f"no score for {silent} of ")


def test_training_is_not_counted_a_frame(two_laps):
    data = load_tum(two_laps)
    (outcome,) = evaluate(data, [("x", Says(np.zeros((40, 40)), training_stages=("training",)))]).outcomes
    assert outcome.seconds_on_frames == 1.0


def test_scores_of_another_size_are_refused(two_laps):
    with pytest.raises(InputError, match="the scores are 3 x 3, the truth is 40 x 40"):
        evaluate(load_tum(two_laps), [("x", Says(np.zeros((3, 3))))])


def test_two_methods_of_one_name_are_refused(two_laps):
    with pytest.raises(InputError, match='two methods are called "x"'):
        evaluate(load_tum(two_laps), [("x", Says(np.zeros((40, 40)))), ("x", Says(np.zeros((40, 40))))])


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("features:a/siamese_8.npz:cosine", "siamese_8 (cosine)"),
        ("Siamese (8)=features:a.npz", "Siamese (8)"),
        ("a + b=thumbnails", "a + b"),
        ("thumbnails:width=16", "thumbnails"),
    ],
)
def test_labels(text, name):
    assert named_method(text, MethodContext())[0] == name


def test_methods_that_refine_another():
    method = make_method("seqslam+features:a.npz:cosine", MethodContext(exclude_frames=7))
    assert isinstance(method, SeqSlam)
    assert method.name == "seqslam+a (cosine)"
    assert method.inner == FeatureMethod(Path("a.npz"), Path("a.npz"), "cosine")
    assert method.exclude_frames == 7


@pytest.mark.parametrize("spec", ["magic", "magic:a=1", "seqslam+magic", ""])
def test_unknown_methods_list_the_known(spec):
    with pytest.raises(InputError, match="known: fabmap, bow"):
        make_method(spec)


@pytest.mark.parametrize("name", METHODS)
def test_every_name_of_the_registry_is_there(name):
    argument = ":a.npz" if name == "features" else ""
    assert make_method(name + argument).name

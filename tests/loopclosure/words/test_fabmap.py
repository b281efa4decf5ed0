"""FAB-MAP against a compiled openFABMAP (the worked examples)."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from loopclosure.errors import InputError
from loopclosure.words.chow_liu import WordTree, learn_tree
from loopclosure.words.fabmap import FabMapModel, FabMapSettings, log_odds


def rows(text: str) -> np.ndarray:
    return np.array([[int(digit) for digit in row] for row in text.split()])


TRAIN_A = rows("11001 11000 11100 00110 00111 00100 10001 01010 00010 11001")
PLACES_A = rows("11001 00110 10010")
TRAIN_B = rows(
    "111001 111111 100001 000110 101001 101000 111111 111111 000001 001001 111101 011000 011111 011001 011000 111001"
)
PLACES_B = rows("101001 010110 111000 000100")
EXAMPLES = {"A": (TRAIN_A, PLACES_A), "B": (TRAIN_B, PLACES_B)}


def synthetic_walk(images: int = 60, words: int = 80, seed: int = 0) -> tuple[WordTree, np.ndarray, np.ndarray]:
    """Return the tree and words of a training walk, and the words of another one that passes its places twice."""
    rng = np.random.default_rng(seed)
    common = rng.random(words) * 0.3
    training = rng.random((50, words)) < common
    training[:, 1::2] |= training[:, ::2] & (rng.random((50, words // 2)) < 0.6)
    lap = rng.random((images // 2, words)) < common
    again = lap ^ (rng.random(lap.shape) < 0.03)
    walk = np.concatenate([lap, again])
    walk[7] = False  # an image without a single feature
    return learn_tree(training), training, walk


@pytest.mark.parametrize("case", json.loads(Path(__file__).with_name("openfabmap.json").read_text()))
def test_worked_examples(case: dict[str, Any]) -> None:
    """The numbers in the file are openFABMAP's."""
    (training, places), query = EXAMPLES[case["example"]], rows(case["query"])
    model = FabMapModel(learn_tree(training), training, FabMapSettings(**case["settings"]))
    odds = np.exp(log_odds(model, query, places)[0])
    if "loglik" in case:  # its FAB-MAP 2.0 leaves out what the likelihoods of all places share
        loglik, loglik_new = model.likelihoods(query, places)[0], model.new_place(query)[0]
        np.testing.assert_allclose(loglik - loglik_new, np.subtract(case["loglik"], case["loglik_new"]), atol=1e-8)
    posterior = np.array([1, *odds]) / (1 + odds.sum())  # of a new place and of each place
    np.testing.assert_allclose(0.99 * posterior + 0.01 / len(posterior), case["posterior"], atol=1e-8)


def test_two_traverses_are_located_on_a_finished_map() -> None:
    tree, training, walk = synthetic_walk()
    odds = log_odds(FabMapModel(tree, training), walk[30:], walk[:30])
    assert np.mean(np.argmax(odds, axis=1) == np.arange(30)) > 0.9


def test_a_place_seen_again_unchanged_wins_among_places_with_as_many_words() -> None:
    rng = np.random.default_rng(5)
    places = np.zeros((40, 60), bool)
    for place in places:
        place[rng.choice(60, 12, replace=False)] = True
    training = rng.random((80, 60)) < 0.2
    model = FabMapModel(learn_tree(training), training)
    np.testing.assert_array_equal(np.argmax(model.likelihoods(places, places), axis=1), np.arange(40))


def test_frequent_words_weigh_less_than_rare_ones() -> None:
    rng = np.random.default_rng(6)
    training = rng.random((100, 30)) < 0.2
    training[:, 10] = True
    training[:, 11] = np.arange(100) < 2
    model = FabMapModel(learn_tree(training), training)
    place = rng.random(30) < 0.2
    place[[10, 11]] = False

    def odds(*words: int) -> float:
        seen = place.copy()
        seen[list(words)] = True
        return float(log_odds(model, seen[None], seen[None])[0, 0])

    common, rare = odds(10) - odds(), odds(11) - odds()
    assert abs(common) < 0.2 < rare


def test_images_without_words_are_places() -> None:
    tree, training, _ = synthetic_walk()
    walk = np.zeros((4, len(tree)), bool)
    walk[[1, 3]] = training[0]
    found = log_odds(FabMapModel(tree, training), walk)
    assert found[2, 0] > found[2, 1]  # nothing looks more like nothing than like something
    assert found[3, 1] == np.nanmax(found[3])


def test_the_second_lap_finds_the_first() -> None:
    tree, training, walk = synthetic_walk()
    found = log_odds(FabMapModel(tree, training, FabMapSettings(recent=4)), walk)
    np.testing.assert_array_equal(np.isfinite(found), np.tri(60, 60, -5, dtype=bool))
    assert np.mean(np.nanargmax(found[30:], axis=1) == np.arange(30)) > 0.8


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"hit": 0.2, "false_alarm": 0.3}, "false_alarm < hit"),
        ({"recent": -1}, "recent is -1"),
    ],
)
def test_invalid_settings_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        FabMapSettings(**settings)


def test_a_sampled_new_place_needs_training_images() -> None:
    with pytest.raises(InputError, match="sampled from the words of training images"):
        FabMapModel(learn_tree(TRAIN_A), TRAIN_A[:0])


def test_words_of_another_vocabulary_are_refused() -> None:
    with pytest.raises(InputError, match=r"shape \(16, 6\), the vocabulary 5 words"):
        FabMapModel(learn_tree(TRAIN_A), TRAIN_B)

from __future__ import annotations

import numpy as np

from netspec.data.random_words import permutation, words


def test_a_record_draws_the_same_in_any_batch() -> None:
    whole = words(7, "data/TRAIN", 0, 100)
    parts = np.concatenate([words(7, "data/TRAIN", first, 20) for first in range(0, 100, 20)])
    assert (whole == parts).all()


def test_the_draws_are_what_they_have_always_been() -> None:
    # A resumed run must draw what the first one would have drawn, whatever the versions of numpy.
    assert words(1, "a", 0, 1).tolist() == [
        [16125938745833911740, 11915995768183236433, 13288515000938474924, 528424593193280505]
    ]
    assert permutation(1, "a", 9).tolist() == [3, 5, 6, 1, 7, 2, 0, 4, 8]


def test_seed_and_stream_matter() -> None:
    drawn = [words(seed, stream, 0, 4).tolist() for seed in (0, 1) for stream in ("data/TRAIN", "data/TEST")]
    assert all(drawn[i] != drawn[j] for i in range(4) for j in range(i))


def test_draws_are_spread_evenly() -> None:
    quarters = np.bincount((words(0, "x", 0, 25_000).ravel() % 4).astype(int))
    assert np.abs(quarters / 25_000 - 1).max() < 0.03


def test_a_permutation_holds_each_number_once() -> None:
    assert sorted(permutation(3, "x", 1001)) == list(range(1001))
    assert permutation(3, "x", 0).tolist() == []

"""Stamps of 0 and stamps that go back become times of receipt, by the clock of the others."""

import numpy as np
import pytest

from loopclosure.places.stamps import mended

DAY = 1_700_000_000.0


@pytest.mark.parametrize(
    ("stamps", "wanted", "count"),
    [
        ([0.5, 1, 2, 3, 4], [0.5, 1, 2, 3, 4], 0),
        ([0, 0, 1, 2, 3], [0, 0, 1, 2, 3], 0),  # a simulation starts at 0
        ([DAY, DAY, DAY + 2, DAY + 3], [DAY, DAY, DAY + 2, DAY + 3], 0),
        ([0, DAY + 1, DAY + 2], [DAY, DAY + 1, DAY + 2], 1),
        ([DAY + 10, DAY + 11, 0, DAY + 13], [DAY + 10, DAY + 11, DAY + 12, DAY + 13], 1),
        ([DAY, DAY + 1, DAY + 900, DAY + 3, DAY + 4], [DAY, DAY + 1, DAY + 2, DAY + 3, DAY + 4], 1),
        ([DAY, DAY + 1, DAY + 2, DAY - 50, DAY - 49], [DAY, DAY + 1, DAY + 2, DAY + 3, DAY + 4], 2),
        ([1, 2, 0, 4], [1, 2, 3, 4], 1),
        ([0, 0, 0], [DAY, DAY + 1, DAY + 2], 3),
        ([1, 2, 2.9, 2.8, 4], [1, 2, 2.5, 2.8, 4], 1),  # two messages in the wrong order: between their neighbors
        ([DAY], [DAY], 0),
        ([], [], 0),
    ],
)
def test_stamps_are_mended(stamps: list[float], wanted: list[float], count: int) -> None:
    received = DAY + np.arange(len(stamps))
    found, replaced, _ = mended(np.array(stamps, float), received)
    assert int(np.count_nonzero(replaced)) == count
    assert np.all(np.diff(found) >= 0)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=0.11)


def test_a_topic_without_any_stamp_has_the_clock_of_the_other() -> None:
    received = DAY + np.arange(4.0)
    _, _, offset = mended(np.array([DAY - 7, 0, DAY - 5, DAY - 4]), received)
    assert offset == -7
    assert mended(np.zeros(4), received, offset)[0].tolist() == (received - 7).tolist()

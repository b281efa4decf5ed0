"""tools/bench revisits: how drives are judged."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks import revisits


def test_real_drives_are_judged_by_two_rules_and_only_by_pairs_that_count() -> None:
    """Frame 9 shows frame 1, 10 frame 5 at another angle, 11 another place, and 8 the frame before it."""
    rule, wide = np.zeros((2, 12, 12), bool)
    rule[9, 1] = wide[9, 1] = wide[10, 5] = True
    real = revisits.Real("a", [Path(f"{i}.png") for i in range(12)], rule, wide, revisits._pairs_before(12, 2), gap=2)
    match = np.full(12, -1)
    match[8:] = 7, 1, 5, 0
    row = revisits.judged(real, match, "detect")
    assert {name: row[name] for name in ("frames", "accepted", "right 15", "right 45")} == {
        "frames": 12,
        "accepted": 3,
        "right 15": 1,
        "right 45": 2,
    }
    assert (row["recall 15"], row["recall 45"], row["with a loop 45"]) == (1.0, 1.0, 2)
    assert revisits.judged(real, match, "map query")["accepted"] == 3
    road = replace(real, name="road: a")
    assert {revisits.judged(road, match, how)["chosen on"] for how in revisits.HOW} == {""}
    assert [part.tolist() for part in real.third(1)] == [[4, 5, 6, 7], [0, 1, 2, 3, 8, 9, 10, 11]]

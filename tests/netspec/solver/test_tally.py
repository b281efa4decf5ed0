import pytest
import torch

from netspec.solver.testing import Tally, score_lines


def test_a_tally_is_the_mean_of_each_element_over_the_batches():
    tally = Tally()
    assert tally.add(torch.tensor(1.0), {"loss": torch.tensor(1.0), "acc": torch.tensor([[1.0, 2.0]])}) == {
        "loss": [1.0],
        "acc": [1.0, 2.0],
    }
    tally.add(torch.tensor(2.0), {"loss": torch.tensor(2.0), "acc": torch.tensor([[3.0, 2.0]])})
    assert tally.loss == pytest.approx(1.5)
    assert tally.scores == {"loss": [1.5], "acc": [2.0, 2.0]}


def test_scores_are_printed_with_their_part_of_the_loss():
    lines = score_lines({"acc": [0.5, 1 / 3], "loss": [2.0]}, {"acc": 0.0, "loss": 0.3})
    assert list(lines) == ["acc = 0.5", "acc = 0.333333", "loss = 2 (* 0.3 = 0.6 loss)"]

"""Layers of text recognition: CTC loss, decoding, accuracy, sequences, and Lstm."""

import sys
from collections.abc import Callable

import pytest
import torch

from netspec.errors import SpecError
from netspec.layers import Layer

Build = Callable[..., Layer]
STEPS, ITEMS, CLASSES = 4, 2, 3


def test_ctc_loss_is_equal_for_all_forms_of_its_bottoms(build: Build) -> None:
    """Two bottoms: labels from 1. Three: labels from 0, with indicators. Four: labels from 1, with lengths."""
    scores = torch.randn(STEPS, ITEMS, CLASSES)
    plain = build("text", "type: 'CTCLoss'", scores.shape, (ITEMS, 2)).run(scores, torch.tensor([[1.0, 2], [2, 0]]))
    begins = torch.ones(STEPS, ITEMS).index_fill(0, torch.tensor([0]), 0)
    labels = torch.tensor([[0.0, 1], [1, -1], [-1, -1], [-1, -1]])
    three = build("text", "type: 'CTCLoss'", scores.shape, (STEPS, ITEMS), (4, 2)).run(scores, begins, labels)
    lengths = torch.full((ITEMS,), float(STEPS)), torch.tensor([2.0, 1])
    flat = torch.tensor([[1.0, 2], [2, 0]])
    four = build("text", "type: 'CTCLoss'", scores.shape, (ITEMS,), (ITEMS,), (2, 2)).run(scores, *lengths, flat)
    other = "type: 'CtcLoss' ctc_loss_param { alphabet_size: 3 time_step: 4 }"
    fourth = build("text", other, scores.shape, (ITEMS, 2)).run(scores, torch.tensor([[1.0, 2], [2, 0]]))
    assert plain[0].item() == three[0].item() == four[0].item() == fourth[0].item()


SCORES = torch.eye(3)[torch.tensor([[1, 2], [1, 0], [0, 0], [1, 1]])]  # the paths 1 1 0 1 and 2 0 0 1


@pytest.mark.parametrize(
    ("given", "texts"),
    [("", [[1, 1], [2, 1]]), ("ctc_merge_repeated: false", [[1, 1, 1], [2, 1]]), ("blank_index: 1", [[0], [2, 0]])],
    ids=["default", "without_merging", "blank_1"],
)
def test_greedy_decoder_merges_repeated_labels_and_removes_blanks(
    build: Build, given: str, texts: list[list[int]]
) -> None:
    layer = build("text", f"type: 'CTCGreedyDecoder' ctc_decoder_param {{ {given} }}", SCORES.shape)
    assert layer.run(SCORES)[0].reshape(2, 4).tolist() == [text + [-1] * (4 - len(text)) for text in texts]


def test_edit_distance_equals_known_values(build: Build) -> None:
    build("text", "type: 'Reverse'", (1,))
    edit_distance = sys.modules["netspec.dialects.text.ctc"].edit_distance
    assert [edit_distance(a, b) for a, b in (("kitten", "sitting"), ("", "ab"), ("ab", "ab"), ("abc", "c"))] == [
        3,
        2,
        0,
        2,
    ]


def test_reverse_time_sets_nan_and_infinity_behind_a_sequence_to_zero(build: Build) -> None:
    data = torch.tensor([1.0, 2, torch.nan, torch.inf]).reshape(4, 1, 1).requires_grad_()
    layer = build("text", "type: 'ReverseTime'", data.shape, (1,))
    (top,) = layer.run(data, torch.tensor([2.0]))
    assert top.flatten().tolist() == [2, 1, 0, 0]
    (gradient,) = torch.autograd.grad(top, data, torch.tensor([3.0, 4, torch.nan, torch.inf]).reshape(4, 1, 1))
    assert gradient.flatten().tolist() == [4, 3, 0, 0]


LSTM = "type: 'Lstm' lstm_param { num_output: 3 weight_filler { type: 'uniform' min: -1 max: 1 } %s }"


def test_lstm_state_continues_where_the_second_bottom_is_one(build: Build) -> None:
    data = torch.randn(4, 2, 5)
    whole = build("text", LSTM % "", data.shape)
    parts = build("text", LSTM % "", (2, 2, 5), (2, 2))
    parts.load_state_dict(whole.state_dict())
    first = parts.run(data[:2], torch.tensor([[0.0, 0], [1, 1]]))[0]
    resumed = build("text", LSTM % "", (2, 2, 5), (2, 2))  # a training, from a snapshot
    resumed.load_state_dict(parts.state_dict())
    resumed.restore(parts.running_state())
    for each in (parts, resumed):
        second = each.run(data[2:], torch.ones(2, 2))[0]
        torch.testing.assert_close(torch.cat([first, second]), whole.run(data)[0])
    with pytest.raises(SpecError, match=r"found states of shapes \[\(3, 3\)\], expected 2 of \(2, 3\)"):
        resumed.restore({"state": (torch.zeros(3, 3),)})
    assert whole.running_state() == {}


@pytest.mark.parametrize(
    ("line", "others", "fault"),
    [
        ("", [[[1.0, 3], [1, 1]]], "label 3, expected 0 to 2"),
        ("ctc_loss_param { blank_index: 3 }", [[[1.0], [1]]], "label 3, expected 0 to 2"),
        ("", [[9.0, 2], [1, 1], [[1, 1], [1, 1]]], "9 steps, expected 0 to 4"),
    ],
    ids=["label", "blank", "steps"],
)
def test_invalid_labels_and_steps_are_refused(line: str, others: list[object], fault: str, build: Build) -> None:
    bottoms = [torch.zeros(4, 2, 3), *map(torch.tensor, others)]
    layer = build("text", f"type: 'CTCLoss' {line}", *(tuple(each.shape) for each in bottoms))
    with pytest.raises(SpecError, match=f"found {fault}"):
        layer.run(*bottoms)


def test_labels_of_one_axis_are_texts_of_one_letter(build: Build) -> None:
    scores, labels = torch.randn(4, 2, 3), torch.tensor([1.0, 2.0])
    line = "type: 'CtcLoss' ctc_loss_param { alphabet_size: 3 time_step: 4 blank_label: 0 }"
    tops = [build("text", line, (4, 2, 3), shape).run(scores, labels.view(shape))[0] for shape in ((2,), (2, 1))]
    assert torch.equal(*tops)


@pytest.mark.parametrize("items", [1, 2])
def test_lstm_of_rows_equals_that_of_steps_and_items(build: Build, items: int) -> None:
    """junhyukoh's own layout: (T N, C), the items of a step behind each other."""
    data, begins = torch.randn(4, items, 5), torch.ones(4, items).index_fill(0, torch.tensor([0, 2]), 0)
    plain = build("text", LSTM % "", data.shape, begins.shape)
    rows = build("text", LSTM % f"batch_size: {items}", (4 * items, 5), (4 * items, 1))
    for ours, theirs in zip(rows.blobs, plain.blobs, strict=True):
        ours.data.copy_(theirs.data)
    for _ in range(2):  # the state continues
        found = rows.run(data.reshape(-1, 5), begins.reshape(-1, 1))[0]
        assert torch.equal(found, plain.run(data, begins)[0].reshape(-1, 3))


def test_lstm_of_rows_that_are_no_multiple_of_the_items_is_refused(build: Build) -> None:
    with pytest.raises(SpecError) as caught:
        build("text", LSTM % "batch_size: 3", (4, 5))
    assert caught.value.where is not None
    assert caught.value.where.type == "Lstm"

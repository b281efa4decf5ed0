"""R-FCN's choice of the hardest regions (online hard example mining)."""

from collections.abc import Callable

import torch

from netspec.layers import Layer

Build = Callable[..., Layer]


def regions_of(images: list[int]) -> torch.Tensor:
    return torch.tensor([[float(image), 0, 0, 5, 5] for image in images])


def test_box_annotator_ohem_keeps_the_hardest_regions_of_each_image(build: Build) -> None:
    regions, losses = regions_of([0, 1, 0, 1, 0]), torch.tensor([0.5, 3, 0.75, 1, 0.25]).reshape(5, 1, 1, 1)
    labels, weights = torch.tensor([4.0, 3, 2, 1, 0]), torch.arange(10.0).reshape(5, 2)
    text = "type: 'BoxAnnotatorOHEM' box_annotator_ohem_param { roi_per_img: %d ignore_label: -1 }"
    layer = build("rfcn", text % 1, (5, 5), (5, 1, 1, 1), (5,), (5, 2), tops=2)
    kept, chosen = layer.run(regions, losses, labels, weights)
    assert kept.flatten().tolist() == [-1, 3, 2, -1, -1]
    assert chosen.reshape(5, 2).tolist() == [[0, 0], [2, 3], [4, 5], [0, 0], [0, 0]]
    assert layer.top_shapes == [(5, 1, 1, 1), (5, 2, 1, 1)] == [tuple(kept.shape), tuple(chosen.shape)]
    layer = build("rfcn", text % 2, (5, 5), (5, 1, 1, 1), (5,), (5, 2), tops=2)
    assert layer.run(regions, losses, labels, weights)[0].flatten().tolist() == [4, 3, 2, 1, -1]

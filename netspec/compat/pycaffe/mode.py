"""Settings for all nets built from now on: the device, the seed, and which sums are exact.

Caffe: class Caffe (include/caffe/common.hpp)
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass, field

import torch

from netspec import log
from netspec.errors import check_choice
from netspec.exact import CHOICES, SMALL
from netspec.graph.options import BuildOptions
from netspec.graph.speed import speed
from netspec.layers.contract.context import Random


@dataclass
class _Mode:
    gpu: bool = False
    device: int = 0
    warned: bool = False
    seed: int | None = None
    nets: int = 0  # nets built since the seed was set
    exact: str = SMALL
    draws: weakref.WeakSet[Random] = field(default_factory=weakref.WeakSet)


_mode = _Mode()


def set_mode_cpu() -> None:
    """Use the CPU for nets built from now on."""
    _mode.gpu = False


def set_mode_gpu() -> None:
    """Use the GPU for nets built from now on; without a GPU, use the CPU, with one warning."""
    _mode.gpu = torch.cuda.is_available()
    if not _mode.gpu and not _mode.warned:
        _mode.warned = True
        log.warning("common.cpp:152", "set_mode_gpu: torch finds no GPU here; nets run on the CPU")


def set_device(device_id: int) -> None:
    """Choose the GPU by its number, for nets built from now on."""
    if torch.cuda.is_available() and not 0 <= device_id < torch.cuda.device_count():
        raise ValueError(f"found device {device_id}, but torch finds {torch.cuda.device_count()} GPU(s) here")
    _mode.device = device_id


def device() -> torch.device:
    """Return the device on which nets are built."""
    return torch.device("cuda", _mode.device) if _mode.gpu else torch.device("cpu")


def set_random_seed(seed: int) -> None:
    """Set the seed of random numbers: for fillers of later nets, and for Dropout and the like in existing nets."""
    _mode.seed, _mode.nets = int(seed), 0
    for random in _mode.draws:
        random.restart(_mode.seed)


def next_seed() -> int | None:
    """Return the seed of the next net; None if none was set."""
    if _mode.seed is None:
        return None
    _mode.nets += 1
    return _mode.seed + _mode.nets - 1


def follow_seed(random: Random) -> None:
    """Restart the random numbers of a net whenever a seed is set."""
    _mode.draws.add(random)


def set_exact(choice: str) -> None:
    """Set which sums are bit-identical to Caffe's, in nets built from now on: "none", "small" or "all".

    Not in Caffe; see netspec/exact/__init__.py.
    """
    check_choice("exact", choice, CHOICES)
    _mode.exact = choice


def exact() -> str:
    """Return the current setting of :func:`set_exact`."""
    return _mode.exact


def build_options() -> BuildOptions:
    """Return the options for the next net."""
    return BuildOptions(
        str(device()), next_seed(), allow_python=True, exact=_mode.exact, accumulate_in_place=True, speed=speed()
    )

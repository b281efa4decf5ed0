"""What other systems lack is said once, and the command goes on."""

from collections.abc import Callable
from typing import Any

import pytest

from netspec.files import whole_file


def test_a_training_without_file_locks(
    run: Callable[..., Any], edited: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(whole_file, "fcntl", None)
    changes = ("max_iter: 60", "max_iter: 1", "snapshot_after_train: false", "snapshot_after_train: true")
    result = run("train", edited("sgd_step/solver.prototxt", *changes))
    assert result.status == 0
    assert result.err.count("no file locks here: nothing stops another training") == 1

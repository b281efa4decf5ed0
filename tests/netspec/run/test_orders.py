"""Sums over classes in the order in which BLAS adds."""

import numpy as np
import pytest

from netspec.exact.blas import one_thread
from netspec.fast import orders


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(5, 2, 1), (64, 10, 1), (9, 4, 9), (7, 64, 1), (6, 21, 3), (3, 10, 1), (5, 1000, 1)])
def test_sums_of_classes_are_those_of_blas_bit_by_bit(shape: tuple[int, int, int], dtype: type) -> None:
    random = np.random.default_rng(3)
    values = (random.uniform(0, 1, shape) * np.exp2(random.integers(-20, 20, shape))).astype(dtype)
    with one_thread():
        assert orders.class_sums(values).tobytes() == orders._by_calls(values).tobytes()


def test_an_order_that_is_not_proven_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    def backwards(values: np.ndarray) -> np.ndarray:
        calls.append(len(values))
        return np.add.accumulate(values[:, ::-1], 1)[:, -1]

    calls: list[int] = []
    monkeypatch.setattr(orders, "_order", orders._order.__wrapped__)
    monkeypatch.setattr(orders, "_by_calls", backwards)
    values = np.random.default_rng(0).uniform(size=(8, 10, 1)).astype(np.float32)
    assert (orders.class_sums(values) == backwards(values)).all()
    assert orders._order(10, 1, "f") is None

"""A training whose last bits depend on the number of threads says so, once, and offers the remedy."""

from collections.abc import Callable

import pytest

from netspec.net.net import Net
from netspec.solver.checks import dependence

NET = """
layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 dim: 1024 } } }
layer { name: "small" type: "InnerProduct" bottom: "data" top: "small" inner_product_param { num_output: 10 } }
layer { name: "large" type: "InnerProduct" bottom: "data" top: "large" inner_product_param { num_output: 1000 } }
layer { name: "relu" type: "ReLU" bottom: "large" top: "relu" }
"""


@pytest.mark.parametrize(
    ("exact", "threads", "said"),
    [
        ("small", 2, "2 threads share the sums of large: "),
        ("none", 4, "4 threads share the sums of small and 1 more: "),
        ("small", 1, ""),
        ("all", 2, ""),
    ],
)
def test_threads_that_change_bits(net_of: Callable[..., Net], exact: str, threads: int, said: str) -> None:
    found = dependence(net_of(NET, exact=exact), threads)
    assert found.startswith(said)
    assert bool(found) == bool(said)
    assert ("--exact all" in found and "OMP_NUM_THREADS=1" in found) == bool(said)

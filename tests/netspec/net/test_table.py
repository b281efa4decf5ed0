"""The table of a net, a row per layer, as text of any width and as JSON."""

from collections.abc import Callable

from netspec.net.net import Net
from netspec.net.table import table

WEIGHTS = 'param { name: "w" } inner_product_param { num_output: 4 bias_term: false }'
NET = f"""
name: "towers"
layer {{ name: "x" type: "Input" top: "a" top: "b" input_param {{ shape {{ dim: 2 dim: 3 }} }} }}
layer {{ name: "left" type: "InnerProduct" bottom: "a" top: "fa" {WEIGHTS} }}
layer {{ name: "right" type: "InnerProduct" bottom: "b" top: "fb" {WEIGHTS} }}
layer {{ name: "loss" type: "EuclideanLoss" bottom: "fa" bottom: "fb" top: "loss" }}
layer {{ name: "hush" type: "Silence" bottom: "fb" }}
"""


def test_str_of_a_net_is_its_table(net_of: Callable[..., Net]) -> None:
    net = net_of(NET)
    assert str(net) == repr(net)
    head, titles, *rows = str(net).splitlines()
    assert head == "towers, phase TEST"
    assert titles.split() == ["layer", "type", "bottoms", "tops", "shapes", "parameters", "MiB", "multiply-adds"]
    assert [" ".join(row.split()) for row in rows] == [
        "x Input - a, b 2x3, 2x3 0.00",
        "left InnerProduct a fa 2x4 12 0.00 24",
        "right InnerProduct b fb 2x4 shared 0.00 24",
        "loss EuclideanLoss fa, fb loss scalar 0.00",
        "hush Silence fb - - 0.00",
        "total 12 0.00 48",
    ]
    assert (
        len({line.index(word) for line, word in zip(rows, ("Input", "InnerP", "InnerP", "Euclid"), strict=False)}) == 1
    )


def test_long_names_are_shortened_in_the_middle_in_a_narrow_table(net_of: Callable[..., Net]) -> None:
    net = net_of(NET.replace("left", "inception_5b_" + 30 * "x" + "_reduce"))
    lines = table(net.plan, list(net.layers), 80).splitlines()
    assert max(map(len, lines)) <= 80
    assert any(line.startswith("inception") and "…" in line and "_reduce" in line for line in lines)

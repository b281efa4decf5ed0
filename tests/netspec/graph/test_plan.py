"""The Plan of a net: blobs, owners of parameters, multipliers, outputs, errors, and which layers need backward."""

import pytest

from case_files import read_cases
from netspec.errors import SpecError
from netspec.graph.plan import make_plan, plan_backward
from netspec.graph.splits import insert_splits
from netspec.proto.text import parse_net_text


def plan(text: str):
    net, source = parse_net_text(text, "net")
    return make_plan(*insert_splits(net, source))


def test_an_in_place_layer_writes_a_new_value_under_the_old_name() -> None:
    made = plan(
        """
        layer { name: "d" type: "Input" top: "x" }
        layer { name: "r" type: "ReLU" bottom: "x" top: "x" }
        layer { name: "t" type: "TanH" bottom: "x" top: "t" }
        """
    )
    assert made.blobs == ("x", "x", "t")
    assert (made.nodes[1].bottoms, made.nodes[1].tops, made.nodes[1].in_place) == ((0,), (1,), (True,))
    assert made.nodes[2].bottoms == (1,)


def test_outputs_are_in_alphabetical_order() -> None:
    assert list(plan('layer { name: "d" type: "Input" top: "zeta" top: "alpha" top: "Beta" }').outputs) == [
        "Beta",
        "alpha",
        "zeta",
    ]


def test_the_first_layer_owns_a_shared_parameter() -> None:
    made = plan(
        """
        layer { name: "d" type: "Input" top: "x" top: "y" }
        layer { name: "a" type: "InnerProduct" bottom: "x" top: "a" param { name: "w" } param { lr_mult: 2 } }
        layer { name: "b" type: "InnerProduct" bottom: "y" top: "b" param { name: "w" lr_mult: 3 decay_mult: 0 } }
        """
    )
    owner, own = made.nodes[1].params
    assert (owner.owner, owner.lr_mult, owner.decay_mult) == (None, 3, 0)
    assert (own.name, own.owner, own.lr_mult) == ("", None, 2)
    assert made.nodes[2].params[0].owner == (1, 0)


FAULTS = read_cases("netspec/graph/cases/faults.txt")


@pytest.mark.parametrize("case", FAULTS.values(), ids=FAULTS)
def test_errors_contain_their_place(case: dict[str, str]) -> None:
    with pytest.raises(SpecError, match=case["message"]):
        plan(case["net"])


def test_a_report_function_receives_all_errors() -> None:
    faults: list[SpecError] = []
    net, source = parse_net_text(
        'layer { name: "a" type: "ReLU" bottom: "no" top: "x" }\n'
        'layer { name: "b" type: "ReLU" bottom: "nor" top: "x" }',
        "net",
    )
    make_plan(*insert_splits(net, source.reporting_to(faults.append)))
    assert len(faults) == 3


TOWER = """
layer {{ name: "d" type: "Input" top: "x" top: "label" }}
layer {{ name: "low" type: "InnerProduct" bottom: "x" top: "low" }}
layer {{ name: "high" type: "InnerProduct" bottom: "low" top: "high" {propagate} }}
layer {{ name: "loss" type: "EuclideanLoss" bottom: "high" bottom: "label" top: "loss" }}
layer {{ name: "aside" type: "InnerProduct" bottom: "label" top: "aside" }}
"""


def _needs(propagate: str, force: str = "") -> tuple[tuple[bool, ...], tuple[tuple[bool, ...], ...]]:
    made = plan(force + TOWER.format(propagate=propagate))
    names = [node.name for node in made.nodes]
    learns = [node.type == "InnerProduct" for node in made.nodes]
    losses = [[name == "loss"] * len(node.tops) for name, node in zip(names, made.nodes, strict=True)]
    labels = [frozenset({1}) if name == "loss" else frozenset() for name in names]
    ignoring = [frozenset[int]()] * len(names)
    backward = plan_backward(made, learns, losses, labels, ignoring)
    by_name = dict(zip(names, backward.layers, strict=True))
    return tuple(by_name[name] for name in ("low", "high", "loss", "aside")), backward.bottoms


def test_only_layers_that_a_loss_depends_on_need_backward() -> None:
    assert _needs("")[0] == (True, True, True, False)


def test_propagate_down_false_stops_backward() -> None:
    assert _needs("propagate_down: false")[0] == (False, True, True, False)


def test_force_backward_reaches_all_but_labels() -> None:
    layers, bottoms = _needs("", "force_backward: true ")
    assert layers == (True, True, True, True)
    assert (True, False) in bottoms

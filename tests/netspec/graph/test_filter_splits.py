"""Which layers a state includes, and the splits that are inserted under Caffe's names."""

from pathlib import Path

import pytest

from netspec.errors import SpecError
from netspec.graph.filter import filter_net, in_state, with_state
from netspec.graph.splits import insert_splits
from netspec.proto.schema import TRAIN, NetParameter, NetState, PhaseValue
from netspec.proto.text import parse_net_text

RULES = (Path(__file__).parent / "nets" / "rules.prototxt").read_text()


@pytest.mark.parametrize(
    ("phase", "level", "stages", "expected"),
    [
        (0, 0, (), "always train shallow not_deploy no_val either"),
        (1, 0, (), "always test shallow not_deploy no_val"),
        (1, 2, ("val",), "always test deep not_deploy either"),
        (1, 1, ("deploy",), "always test shallow no_val"),
        (1, 1, ("deploy", "fast"), "always test shallow deploy no_val"),
    ],
    ids=["TRAIN", "TEST", "level_and_stage", "one_of_two_stages", "two_stages"],
)
def test_filter_net_keeps_the_layers_that_a_state_includes(
    phase: PhaseValue, level: int, stages: tuple[str, ...], expected: str
) -> None:
    net, source = parse_net_text(RULES, "net")
    filtered, positions = filter_net(with_state(net, phase, level, stages), source)
    assert " ".join(layer.name for layer in filtered.layer) == expected
    lines = [RULES.splitlines()[position.where.line - 1] for position in positions.layers]
    assert [line.split('"')[1] for line in lines] == expected.split()
    assert len(net.layer) == 9  # the argument is as it was


def test_include_and_exclude_together_are_refused_with_their_place() -> None:
    net, source = parse_net_text(
        'layer { name: "a" type: "Silence"\n include { phase: TEST } exclude { min_level: 1 } }',
        "f",
    )
    with pytest.raises(SpecError, match=r"^f:2:\d+: layer \"a\" \(Silence\): found both include and exclude"):
        filter_net(net, source)


def test_later_states_override_level_and_add_stages() -> None:
    net = NetParameter(state=NetState(level=7, stage=["own"]))
    state = in_state(net, NetState(phase=TRAIN, level=1), NetState(stage=["a"]), NetState(level=3, stage=["b"])).state
    assert (state.phase, state.level, list(state.stage)) == (0, 3, ["a", "b"])
    assert net.state.level == 7  # the argument is as it was


def _split(text: str) -> list[str]:
    net, source = parse_net_text(text, "net")
    split, positions = insert_splits(net, source)
    assert len(positions.layers) == len(split.layer)
    again, _ = insert_splits(split, positions)
    assert again == split  # nothing is left to split
    return [f"{layer.name}: {','.join(layer.bottom)} -> {','.join(layer.top)}" for layer in split.layer]


def test_a_blob_used_twice_is_split_under_caffes_names() -> None:
    text = """
    layer { name: "data" type: "Input" top: "x" top: "y" }
    layer { name: "a" type: "ReLU" bottom: "y" top: "a" }
    layer { name: "b" type: "ReLU" bottom: "y" top: "b" }
    """
    assert _split(text) == [
        "data:  -> x,y",
        "y_data_1_split: y -> y_data_1_split_0,y_data_1_split_1",
        "a: y_data_1_split_0 -> a",
        "b: y_data_1_split_1 -> b",
    ]


def test_readers_of_an_in_place_result_share_one_split() -> None:
    text = """
    layer { name: "data" type: "Input" top: "x" }
    layer { name: "relu" type: "ReLU" bottom: "x" top: "x" }
    layer { name: "a" type: "TanH" bottom: "x" top: "a" }
    layer { name: "b" type: "TanH" bottom: "x" top: "b" }
    """
    assert _split(text)[2] == "x_relu_0_split: x -> x_relu_0_split_0,x_relu_0_split_1"


def test_a_loss_weight_counts_as_a_use_and_moves_to_the_first_copy() -> None:
    text = """
    layer { name: "data" type: "Input" top: "x" }
    layer { name: "sum" type: "Reduction" bottom: "x" top: "s" loss_weight: 0.5 }
    layer { name: "b" type: "TanH" bottom: "s" top: "b" }
    """
    net, source = parse_net_text(text, "net")
    split, _ = insert_splits(net, source)
    assert list(split.layer[1].loss_weight) == []
    assert list(split.layer[2].loss_weight) == [0.5, 0.0]
    assert split.layer[3].bottom[0] == "s_sum_0_split_1"

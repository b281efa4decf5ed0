"""The table of layer types that several forks define, and the warning about such layers."""

from pathlib import Path

import pytest

import netspec
from netspec.dialects.files import known_files
from netspec.dialects.signatures import SIGNATURES
from netspec.layers import layer_class
from netspec.proto.schema import LayerParameter, fields_of


@pytest.mark.parametrize("kind", SIGNATURES)
def test_the_table_contains_existing_dialects_types_and_fields_only(kind: str) -> None:
    signature = SIGNATURES[kind]
    assert {fork.dialect for fork in signature.forks} <= known_files().keys()
    assert layer_class(kind) is not None
    for fork in signature.forks:
        netspec.use_dialect(fork.dialect)
    for field in (field for fork in signature.forks for field in fork.fields):
        outer, _, inner = field.partition(".")
        found = fields_of(LayerParameter.DESCRIPTOR)[outer]
        assert not inner or inner in fields_of(found.descriptor.message_type)


def test_a_layer_of_several_forks_gets_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    netspec.layer('type: "DiceCoefLoss"', (2, 3), (2, 3))
    assert "several forks define this layer type" in caplog.text


OWN = """
from netspec.layers import Layer, register

@register("DiceCoefLoss")
class Dice(Layer):
    bottoms = (2, 2)

    def reshape(self, bottom_shapes):
        return [()]
"""


def test_a_layer_of_a_plugin_gets_no_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "own_dice.py"
    path.write_text(OWN)
    netspec.use_dialect(path)
    assert type(netspec.layer('type: "DiceCoefLoss"', (2, 3), (2, 3)).layer).__name__ == "Dice"
    assert caplog.text == ""

"""The table of layer types that several forks define, and the warning about such layers."""

from pathlib import Path

import pytest

import netspec
from netspec.dialects.files import known_files
from netspec.dialects.signatures import SIGNATURES
from netspec.layers import layer_class
from netspec.proto.forks import forks
from netspec.proto.schema import LayerParameter, fields_of


@pytest.mark.parametrize("kind", SIGNATURES)
def test_the_table_contains_existing_dialects_types_and_fields_only(kind: str) -> None:
    signature = SIGNATURES[kind]
    assert {name for fork in signature.forks for name in fork.dialects} <= known_files().keys()
    assert layer_class(kind) is not None
    own = fields_of(LayerParameter.DESCRIPTOR)
    for outer, _, inner in (field.partition(".") for fork in signature.forks for field in fork.fields):
        owners = () if outer in own else forks().additions().fields["caffe.LayerParameter", outer]
        found = [forks().field(owner, "caffe.LayerParameter", outer) for owner in owners] or [own[outer]]
        assert not inner or any(inner in fields_of(field.descriptor.message_type) for field in found)


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

"""Invalid settings and bottoms are refused in one line that names the field."""

import pytest

from case_files import read_table, sizes
from contexts import context
from netspec.errors import SpecError, Where
from netspec.net.one_layer import make_layer
from netspec.proto.schema import TEST, TRAIN
from paths import GOLDEN

CASES = read_table("netspec/layers/cases/refused.txt")


def at(*path: str | int) -> Where:
    return Where(".".join(map(str, path)))


@pytest.mark.parametrize("case", CASES, ids=[f"{i} {case['field']}" for i, case in enumerate(CASES)])
def test_an_invalid_field_or_bottom_is_refused_at_its_place(case: dict[str, str]) -> None:
    layer = case["layer"].replace("GOLDEN", str(GOLDEN))
    with pytest.raises(SpecError) as caught:
        make_layer(
            layer,
            sizes(case["bottoms"]),
            context(at=at, phase=TRAIN if case["phase"] else TEST),
            int(case["tops"] or 1),
        )
    assert str(caught.value.where or "") == case["field"]
    assert len(str(caught.value).splitlines()) == 1

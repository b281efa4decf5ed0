"""Invalid settings and bottoms are refused in one line that names the field."""

import pytest

from case_files import read_cases
from contexts import context
from netspec.errors import SpecError, Where
from netspec.net.one_layer import make_layer

CASES = read_cases("netspec/layers/cases/refused.txt")


def at(*path: str | int) -> Where:
    return Where(".".join(map(str, path)))


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_an_invalid_field_or_bottom_is_refused_at_its_place(case: dict[str, str]) -> None:
    shapes = [tuple(map(int, line.split())) for line in case["bottoms"].splitlines()]
    with pytest.raises(SpecError) as fault:
        make_layer(case["layer"], shapes, context(at=at), int(case.get("tops", 1)))
    assert str(fault.value) == case["fault"]

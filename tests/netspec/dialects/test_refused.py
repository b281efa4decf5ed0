"""What layers of dialects refuse when they are built, each in one line that has its place."""

import pytest

from case_files import read_cases
from netspec.dialects import use_dialect
from netspec.errors import SpecError
from netspec.layers import Context
from netspec.net.one_layer import make_layer
from netspec.proto.schema import TEST

CASES = read_cases("netspec/dialects/cases/refused.txt")


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_it_is_refused_at_its_place(case: dict[str, str]) -> None:
    use_dialect(case["dialect"])
    shapes = [tuple(map(int, line.split())) for line in case["bottoms"].splitlines()]
    with pytest.raises(SpecError) as fault:
        make_layer(case["layer"], shapes, Context(TEST), int(case.get("tops", 1)))
    assert str(fault.value) == case["fault"]

"""SENets, which need a dialect, have the output and the number of parameters that their paper states."""

from pathlib import Path

import pytest

from netspec.inspect.check.check import check_file
from netspec.proto.schema import TEST
from paths import SHARED

pytestmark = pytest.mark.slow

SENET = SHARED / "corpus" / "hujie-frank+SENet" / "models"
# Parameters as the SENet paper has them (table 2 and section 4), in millions, without the batch norms' statistics.
PARAMETERS = {"SE-ResNet-50": 28.1, "SE-ResNet-101": 49.3, "SE-ResNet-152": 66.8, "SE-ResNeXt-50": 27.6}


@pytest.mark.parametrize("path", sorted(SENET.glob("*.prototxt")), ids=lambda path: path.stem)
def test_senet_has_the_published_number_of_parameters(path: Path) -> None:
    (checked,) = check_file(path, TEST)
    assert checked.faults == []
    assert checked.net is not None
    assert checked.net.shapes["prob"] == (1, 1000)
    learned = sum(p.parameter.numel() for p in checked.net.learnable if p.lr_mult)
    if path.stem in PARAMETERS:
        assert learned / 1e6 == pytest.approx(PARAMETERS[path.stem], abs=0.1)

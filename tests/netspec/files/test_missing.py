"""What is said of a file that is not there."""

from pathlib import Path

import pytest

from netspec.errors import SpecError
from netspec.proto.binary import check_readable
from netspec.proto.text import read_net, read_solver


@pytest.mark.parametrize("read", [read_net, read_solver, lambda path: check_readable([path])])
@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("nets/solver.prototxt", '; did you mean "nets/solver_1.prototxt"?'),
        ("nest/solver_1.prototxt", '; "." has no "nest"; did you mean "nets"?'),
        ("nets/deep/er/solver.prototxt", '; "nets" has no "deep"'),
        ("other.caffemodel", ""),
        ("nets/gone.prototxt", ""),
    ],
)
def test_how_far_the_path_exists(read, path: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("nets").mkdir()
    Path("nets/solver_1.prototxt").touch()
    with pytest.raises(SpecError) as fault:
        read(path)
    beginning = f"{path}: cannot be read: No such file or directory"
    assert str(fault.value) == f"{beginning}{says}; relative paths start from {tmp_path}"
    with pytest.raises(SpecError) as fault:
        read(str(tmp_path / "wide"))
    assert str(fault.value) == f"{tmp_path}/wide: cannot be read: No such file or directory"

"""Paths relative to others, on one drive and on two, and messages about missing files."""

from pathlib import Path

import pytest

from netspec import use_dialect
from netspec.errors import SpecError
from netspec.files.image_list import list_images
from netspec.files.paths import relative
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


def test_what_was_expected_stands_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("photos").mkdir()
    with pytest.raises(SpecError) as fault:
        list_images("photo")
    expected = "expected a folder of images, or a text file that lists them"
    assert str(fault.value) == (
        f"photo: cannot be read: No such file or directory; {expected}; "
        f'did you mean "photos"?; relative paths start from {tmp_path}'
    )


def test_a_dialect_by_its_path(tmp_path: Path) -> None:
    (tmp_path / "ours.py").touch()
    with pytest.raises(SpecError) as fault:
        use_dialect(str(tmp_path / "our.py"))
    assert str(fault.value) == (
        f'{tmp_path}/our.py: cannot be read: No such file or directory; did you mean "{tmp_path}/ours.py"?'
    )


def test_a_path_on_one_drive(tmp_path: Path) -> None:
    assert relative(tmp_path / "a" / "b", tmp_path / "c") == "../a/b"

"""Every format that is read, from a copy that was interrupted or overwritten: a good result, or one line."""

from collections.abc import Callable
from pathlib import Path

import pytest

from faults.formats import FORMATS
from loopclosure.errors import InputError
from netspec.errors import SpecError

pytestmark = pytest.mark.slow

DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "truncated": lambda data: data[: len(data) // 2],
    "ends in zeros": lambda data: data[: len(data) // 2] + bytes(len(data) - len(data) // 2),
    "another byte": lambda data: data[: len(data) // 3] + b"\xff" + data[len(data) // 3 + 1 :],
}


@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_file_is_read_or_refused_in_one_line(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    form = FORMATS[name]
    path = tmp_path / f"x{form.suffix}"
    form.write(path)
    file = path / form.inside if form.inside else path
    good = file.read_bytes()
    for damaged in DAMAGES.values():
        file.write_bytes(damaged(good))
        said = ""
        try:
            form.read(path)
        except (SpecError, InputError) as fault:
            said = str(fault)
        assert "\n" not in said

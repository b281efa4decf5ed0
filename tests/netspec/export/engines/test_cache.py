"""The folder of exported models: whole entries or none, bounded, by content."""

import json
import os
import time
from pathlib import Path

import pytest

from netspec.errors import SpecError
from netspec.export.engines.cache import ABANDONED, ABOUT, UNFINISHED, entry
from netspec.export.engines.choice import Choice, user_folder
from netspec.export.engines.key import key_of


class Maker:
    """Writes a file of some bytes, and counts how often it does."""

    def __init__(self, size: int = 10) -> None:
        self.size, self.calls = size, 0

    def __call__(self, folder: Path) -> dict[str, str]:
        self.calls += 1
        (folder / "model").write_bytes(b"m" * self.size)
        return {"said": "something"}


def test_an_entry_is_made_once(tmp_path: Path) -> None:
    make, cache = Maker(), tmp_path / "new" / "cache"
    folder, about, made = entry(cache, "key", make)
    assert (folder / "model").read_bytes() == b"m" * 10
    assert (about["said"], made) == ("something", True)
    assert entry(cache, "key", make) == (folder, about, False)
    assert entry(cache, "other", make)[0] != folder
    assert make.calls == 2
    assert sorted(path.name for path in cache.iterdir()) == ["key", "other"]


@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: (folder / "model").write_bytes(b"m" * 9),
        lambda folder: (folder / "model").write_bytes(b"x" * 10),
        lambda folder: (folder / "model").unlink(),
        lambda folder: (folder / ABOUT).write_text('{"files": '),
        lambda folder: (folder / ABOUT).write_text("[]"),
        lambda folder: (folder / ABOUT).unlink(),
    ],
)
def test_a_damaged_entry_is_made_again(damage, tmp_path: Path) -> None:
    make = Maker()
    folder, about, _ = entry(tmp_path, "key", make)
    time.sleep(0.01)  # a file system's clock is coarse
    damage(folder)
    again = entry(tmp_path, "key", make)
    assert (again[0], again[1]["said"], again[2]) == (folder, about["said"], True)
    assert (folder / "model").read_bytes() == b"m" * 10
    assert entry(tmp_path, "key", make)[2] is False


def test_a_maker_that_fails_leaves_nothing(tmp_path: Path) -> None:
    def make(folder: Path) -> dict[str, str]:
        (folder / "half").write_text("a")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        entry(tmp_path, "key", make)
    assert list(tmp_path.iterdir()) == []


def test_the_least_recently_used_go_first(tmp_path: Path) -> None:
    for age, key in enumerate("abc"):
        folder = entry(tmp_path, key, Maker(1000), 3500)[0]
        os.utime(folder / ABOUT, (1000 + age, 1000 + age))
    entry(tmp_path, "a", Maker(1000), 3500)  # used again
    entry(tmp_path, "d", Maker(1000), 3500)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "c", "d"]
    entry(tmp_path, "large", Maker(5000), 3500)
    assert [path.name for path in tmp_path.iterdir()] == ["large"]


def test_what_a_dead_process_left_goes(tmp_path: Path) -> None:
    for name, age in (("old", ABANDONED + 60), ("new", 60)):
        folder = tmp_path / f"{UNFINISHED}{name}"
        folder.mkdir()
        os.utime(folder, (time.time() - age, time.time() - age))
    entry(tmp_path, "key", Maker())
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{UNFINISHED}new", "key"]


def test_an_entry_that_another_process_made_meanwhile_is_used(tmp_path: Path) -> None:
    def make(folder: Path) -> dict[str, str]:
        entry(tmp_path, "key", Maker(20))
        return Maker(20)(folder)

    folder, _, _ = entry(tmp_path, "key", make)
    assert (folder / "model").stat().st_size == 20
    assert [path.name for path in tmp_path.iterdir()] == ["key"]
    assert set(json.loads((folder / ABOUT).read_text())["files"]) == {"model"}


def test_a_key_is_of_contents_and_options(tmp_path: Path) -> None:
    one, same, other = (tmp_path / name for name in ("one", "same", "other"))
    for path, text in ((one, "a"), (same, "a"), (other, "b")):
        path.write_text(text)
    key = key_of([one], {"blob": "feat", "shape": (1, 3)})
    assert key == key_of([same], {"shape": (1, 3), "blob": "feat"})
    assert len({key, key_of([other], {"blob": "feat", "shape": (1, 3)}), key_of([one], {"blob": "feat"})}) == 3
    with pytest.raises(SpecError, match=r"gone: cannot be read: No such file"):
        key_of([tmp_path / "gone"], {})


def test_where_the_cache_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert user_folder() == tmp_path / "netspec"
    assert Choice.of("torch").cache == tmp_path / "netspec"
    assert Choice.of("torch", cache=False).cache is None
    assert Choice.of("torch", cache="here").cache == Path("here")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # which the standard has ignored
    monkeypatch.setenv("HOME", str(tmp_path))
    assert user_folder() == tmp_path / ".cache" / "netspec"


@pytest.mark.parametrize(
    ("engine", "precision", "fault"),
    [
        (
            "onnxruntme",
            "fp32",
            "found engine 'onnxruntme', expected 'torch', 'onnxruntime', 'openvino'; did you mean \"onnxruntime\"?",
        ),
        ("tensorrt", "fp32", "found engine 'tensorrt', expected 'torch', 'onnxruntime', 'openvino'"),
        ("torch", "int8", "found precision 'int8', expected 'fp32', 'bf16'"),
    ],
)
def test_choices_that_there_are_not(engine: str, precision: str, fault: str) -> None:
    with pytest.raises(SpecError) as found:
        Choice.of(engine, precision)
    assert str(found.value) == fault

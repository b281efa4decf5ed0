"""The cache of exported models: its entries, their keys, damage to them, and its folder."""

import logging
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from netspec.errors import SpecError
from netspec.export.engines.cache import DIGESTS, entry, key_of
from netspec.export.engines.choice import Choice, user_folder


class Maker:
    """Write a file of some bytes, and count the calls."""

    def __init__(self, size: int = 10) -> None:
        self.size, self.calls = size, 0

    def __call__(self, folder: Path) -> None:
        self.calls += 1
        (folder / "model").write_bytes(b"m" * self.size)


def test_an_entry_is_made_once(tmp_path: Path) -> None:
    make, cache = Maker(), tmp_path / "new" / "cache"
    folder = entry(cache, "key", make)
    assert (folder / "model").read_bytes() == b"m" * 10
    assert entry(cache, "key", make) == folder
    assert entry(cache, "other", make) != folder
    assert make.calls == 2
    assert sorted(path.name for path in cache.iterdir()) == ["key", "other"]


def test_a_failed_maker_leaves_no_files(tmp_path: Path) -> None:
    def make(folder: Path) -> None:
        (folder / "half").write_text("a")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        entry(tmp_path, "key", make)
    assert list(tmp_path.iterdir()) == []


def test_large_and_old_files_of_others_in_the_folder_are_kept(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    with (photos / "large.jpg").open("wb") as file:
        file.truncate(5 * 2**30)  # sparse
    for folder in (photos, tmp_path / ".unfinished-of-another"):
        folder.mkdir(exist_ok=True)
        os.utime(folder, (0, 0))
    entry(tmp_path, "key", Maker())
    assert (photos / "large.jpg").stat().st_size == 5 * 2**30
    assert sorted(path.name for path in tmp_path.iterdir()) == [".unfinished-of-another", "key", "photos"]


def test_an_entry_that_another_process_makes_meanwhile_is_used(tmp_path: Path) -> None:
    def make(folder: Path) -> None:
        entry(tmp_path, "key", Maker(20))
        Maker(10)(folder)

    folder = entry(tmp_path, "key", make)
    assert (folder / "model").stat().st_size == 20
    assert [path.name for path in tmp_path.iterdir()] == ["key"]


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(lambda folder: (folder / "model").write_bytes(b"m" * 9), id="a shorter file"),
        pytest.param(lambda folder: (folder / "model").write_bytes(b"n" + b"m" * 9), id="a file of other bytes"),
        pytest.param(lambda folder: (folder / "model").unlink(), id="a missing file"),
        pytest.param(lambda folder: (folder / DIGESTS).write_bytes(b"\xff{"), id="an unreadable list of digests"),
    ],
)
def test_a_damaged_entry_is_made_again(
    damage: Callable[[Path], object], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    make = Maker()
    folder = entry(tmp_path, "key", make)
    (folder / "more").write_text("what is added later is no damage")
    assert entry(tmp_path, "key", make) == folder
    damage(folder)
    with caplog.at_level(logging.WARNING):
        assert entry(tmp_path, "key", make) == folder
        assert entry(tmp_path, "key", make) == folder
    assert (folder / "model").read_bytes() == b"m" * 10
    (aside,) = (path for path in tmp_path.iterdir() if path != folder)
    assert caplog.messages == [
        f"{folder}: was damaged and is being recreated; the damaged one was renamed to {aside.name}"
    ]


def test_an_entry_that_is_a_symbolic_link_is_refused(tmp_path: Path) -> None:
    cache, elsewhere = tmp_path / "cache", tmp_path / "elsewhere"
    cache.mkdir()
    elsewhere.mkdir()
    (cache / "key").symlink_to(elsewhere)
    with pytest.raises(SpecError, match="key: is a symbolic link"):
        entry(cache, "key", Maker())
    assert list(elsewhere.iterdir()) == []


def test_a_key_depends_on_contents_and_options_only(tmp_path: Path) -> None:
    one, same, other = (tmp_path / name for name in ("one", "same", "other"))
    for path, text in ((one, "a"), (same, "a"), (other, "b")):
        path.write_text(text)
    key = key_of([one], {"blob": "feat", "shape": (1, 3)})
    assert key == key_of([same], {"shape": (1, 3), "blob": "feat"})
    assert len({key, key_of([other], {"blob": "feat", "shape": (1, 3)}), key_of([one], {"blob": "feat"})}) == 3
    with pytest.raises(SpecError, match=r"gone: cannot be read: No such file"):
        key_of([tmp_path / "gone"], {})


def test_the_cache_is_below_xdg_cache_home_or_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert user_folder() == tmp_path / "netspec"
    assert Choice.of("torch").cache == tmp_path / "netspec"
    assert Choice.of("torch", cache=False).cache is None
    assert Choice.of("torch", cache="here").cache == Path("here")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # the XDG standard says to ignore it
    monkeypatch.setenv("HOME", str(tmp_path))
    assert user_folder() == tmp_path / ".cache" / "netspec"


@pytest.mark.parametrize(
    ("engine", "precision", "said"),
    [
        ("onnxruntme", "fp32", "found engine 'onnxruntme', expected 'torch', 'onnxruntime', 'openvino'; did you mean"),
        ("torch", "int8", "found precision 'int8', expected 'fp32', 'bf16'"),
    ],
)
def test_an_unknown_engine_or_precision_is_refused(engine: str, precision: str, said: str) -> None:
    with pytest.raises(SpecError, match=said):
        Choice.of(engine, precision)

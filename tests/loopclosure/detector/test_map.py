"""Maps on disk: loops between sessions; a query changes nothing; a run that is killed leaves the map as it was."""

import csv
import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from loopclosure.cli import main
from loopclosure.descriptors.thumbnails import Thumbnailer
from loopclosure.detector import LoopDetector
from loopclosure.detector.map import Map
from loopclosure.detector.run import remember_all, run_detector
from loopclosure.detector.verification import GeometricCheck
from loopclosure.errors import InputError
from loopclosure.methods.drive import last_session
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.sequences import read_sequence
from netspec.errors import SpecError
from netspec.files.whole_file import only_one

PLACES = 10


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three drives past the same places: a and b past all of them, c past the last half and some others."""
    folder = tmp_path_factory.mktemp("drives")
    for drive, places in (("a", range(PLACES)), ("b", range(PLACES)), ("c", range(PLACES // 2, 2 * PLACES))):
        (folder / drive).mkdir()
        for number, place in enumerate(places):
            wall = np.random.default_rng(place).integers(0, 256, (15, 20, 3)).astype(np.uint8)
            image = cv2.resize(wall, (160, 120), interpolation=cv2.INTER_NEAREST)
            moved = np.roll(image, (ord(drive) - ord("a"), number % 3), (0, 1))
            cv2.imwrite(str(folder / drive / f"{number:03d}.png"), moved)
    return folder


@pytest.fixture(autouse=True)
def thumbnails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("loopclosure.detector.describers._entry_point", lambda name: Thumbnailer)


def loops(path: Path) -> list[tuple[str, str]]:
    with path.open() as stream:
        return [(row["query_name"], row["match_name"]) for row in csv.DictReader(stream)]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def first(drives: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of drive a."""
    folder = tmp_path_factory.mktemp("maps") / "first"
    Map.create(folder, "thumbnails").add(read_sequence(drives / "a"), Thumbnailer())
    return folder


@pytest.fixture
def a_map(first: Path, tmp_path: Path) -> Map:
    return Map(shutil.copytree(first, tmp_path / "M"))


INDEXES = ["exact"] + ["faiss"] * (find_spec("faiss") is not None) + ["p.db"] * (find_spec("milvus_lite") is not None)


@pytest.mark.slow
@pytest.mark.parametrize("index", INDEXES)
def test_build_add_and_query(
    index: str, drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    more = ["--index", index]
    assert main(["map", "build", "M", str(drives / "a"), *more]) == 0
    assert main(["map", "add", "M", str(drives / "b"), *more]) == 0
    said = capsys.readouterr().out.splitlines()
    first = said.index("session 000000: 10 frames, 0 loops, 0 to earlier sessions: M/000000/loops.csv")
    assert said[-2:] == [
        "session 000001: 10 frames, 10 loops, 10 to earlier sessions: M/000001/loops.csv",
        "20 frames in 2 sessions: M",
    ]
    assert any(line.startswith("verification: 10 of 10 matches") for line in said[first:])
    expected = [(f"000001/{i:03d}.png", f"000000/{i:03d}.png") for i in range(PLACES)]
    assert loops(tmp_path / "M" / "000001" / "loops.csv") == expected
    before = contents(tmp_path / "M")
    assert main(["map", "query", "M", str(drives / "c"), *more, "--out", "found"]) == 0
    assert contents(tmp_path / "M") == before
    query = capsys.readouterr()
    assert "5 of 15 frames are in the map: found/loops.csv" in query.out
    found = loops(tmp_path / "found" / "loops.csv")
    assert [(query, match.partition("/")[2]) for query, match in found] == [
        (f"{i:03d}.png", f"{i + 5:03d}.png") for i in range(5)
    ]


@pytest.mark.slow
def test_the_time_of_a_query_does_not_grow_with_the_number_of_sessions(
    a_map: Map, drives: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The time of a query does not grow with the number of sessions: an image, a line and an unlike pair per frame."""
    for _ in range(3):
        a_map.add(read_sequence(drives / "b"), Thumbnailer())
    verified, agreement = [], GeometricCheck.agreement
    monkeypatch.setattr(GeometricCheck, "agreement", lambda *given: verified.append(1) or agreement(*given))
    detector = a_map.detector(Thumbnailer())
    remember_all(detector, read_sequence(drives / "c"))
    found = [result.match for result in last_session(detector, own=False).results]
    assert [None if match is None else match % PLACES for match in found] == [5, 6, 7, 8, 9] + [None] * PLACES
    assert len(verified) <= 3 * len(found)


DYING = (Path(__file__).parent / "programs" / "dying.py").read_text()


@pytest.mark.slow
def test_a_killed_command_does_not_change_the_map(a_map: Map, drives: Path, tmp_path: Path) -> None:
    before = contents(tmp_path / "M")
    words = [sys.executable, "-c", DYING, str(tmp_path / "M"), str(drives / "b")]
    assert subprocess.run(words, check=False).returncode == -signal.SIGKILL
    left = contents(tmp_path / "M")
    assert {key: value for key, value in left.items() if key in before} == before
    assert any("frames.h5" in key for key in left.keys() - before.keys())
    assert all(".unfinished" in key or key == ".lock" for key in left.keys() - before.keys())
    assert len(Map(tmp_path / "M")) == PLACES
    a_map.add(read_sequence(drives / "b"), Thumbnailer())
    assert len(Map(tmp_path / "M")) == 2 * PLACES


@pytest.mark.slow
def test_one_process_writes_while_others_read(a_map: Map, drives: Path, tmp_path: Path) -> None:
    other = Map(tmp_path / "M")
    with only_one(tmp_path / "M" / ".lock", ""):
        with pytest.raises(SpecError, match="locked by another process"):
            a_map.add(read_sequence(drives / "b"), Thumbnailer())
        assert len(Map(tmp_path / "M").detector(Thumbnailer())) == PLACES
    other.add(read_sequence(drives / "b"), Thumbnailer())
    a_map.add(read_sequence(drives / "c"), Thumbnailer())  # sees what the other has added
    assert [len(session.names) for session in a_map.sessions] == [10, 10, 15]


class Net(Thumbnailer):
    """Like a net, it has a fingerprint."""

    fingerprint = "a net"


def test_a_map_of_another_net_is_refused(drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Map.create(tmp_path / "M", "default").add(read_sequence(drives / "a"), Net())
    Map(tmp_path / "M").detector(Net()).save(tmp_path / "d.npz")
    LoopDetector.load(tmp_path / "d.npz", Net())
    monkeypatch.setattr(Net, "fingerprint", "another")
    fault = r"described by another net \(a net, this is another\); use the version of the package that has it, "
    with pytest.raises(InputError, match=f"M: its frames were {fault}or build the map again from its drives"):
        Map(tmp_path / "M").detector(Net())
    with pytest.raises(InputError, match=fault):
        Map(tmp_path / "M").add(read_sequence(drives / "b"), Net())
    with pytest.raises(InputError, match=f"d.npz: its frames were {fault}or start a new file"):
        LoopDetector.load(tmp_path / "d.npz", Net())
    Map(tmp_path / "M").add(read_sequence(drives / "b"), Thumbnailer())  # of a function nothing is known


def head(**changes: Any) -> Callable[[Path], object]:
    """Change the head of a map."""

    def change(folder: Path) -> None:
        path = folder / "map.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))

    return change


def without(name: str, values: object = None) -> Callable[[Path], object]:
    """Remove an array of a session, or replace it."""

    def change(folder: Path) -> None:
        with h5py.File(folder / "000000" / "frames.h5", "a") as file:
            file.pop(name, None)
            if values is not None:
                file[name] = values

    return change


@pytest.mark.parametrize(
    ("damage", "file"),
    [
        pytest.param(lambda m: (m / "map.json").write_text("{"), "map.json", id="head"),
        pytest.param(head(sessions=-1), "map.json", id="negative"),
        pytest.param(head(sessions=True), "map.json", id="true"),
        pytest.param(head(sessions=["../000000"]), "map.json", id="elsewhere"),
        pytest.param(head(sessions=["000000", "000000"]), "map.json", id="twice"),
        pytest.param(head(describer="./x.py:f"), "map.json", id="program"),
        pytest.param(lambda m: os.truncate(m / "000000" / "frames.h5", 900), "frames.h5", id="cut"),
        pytest.param(without("points"), "frames.h5", id="missing"),
        pytest.param(without("points", np.zeros((3, 2), np.float32)), "frames.h5", id="shape"),
        pytest.param(without("depths", np.zeros(3, np.float32)), "frames.h5", id="depths"),
        pytest.param(without("names", np.frombuffer(b"x", np.uint8)), "frames.h5", id="names"),
        pytest.param(lambda m: pipe(m / "map.json"), "M", id="pipe for the head"),
        pytest.param(lambda m: pipe(m / "000000" / "frames.h5"), "frames.h5", id="pipe"),
        pytest.param(lambda m: shutil.rmtree(m / "000000"), "frames.h5", id="no session"),
    ],
)
def test_damage_is_reported_in_one_line(damage, file: str, a_map: Map, tmp_path: Path) -> None:
    damage(tmp_path / "M")
    with pytest.raises(SpecError) as found:
        Map(tmp_path / "M").detector(Thumbnailer())
    assert found.value.where is not None
    assert Path(found.value.where.file).name == file


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def test_a_file_truncated_while_open_is_an_error(a_map: Map, drives: Path) -> None:
    before = a_map.detector(Thumbnailer())
    os.truncate(a_map.folder / "000000" / "frames.h5", 200)
    with pytest.raises(SpecError, match=r"frames\.h5.* cannot be read"):
        run_detector(before, read_sequence(drives / "b"))


def test_errors_are_reported(a_map: Map, drives: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="exists already; loopclosure map add adds to a map"):
        Map.create(tmp_path / "M", "default")
    with pytest.raises(InputError, match="is not a map"):
        Map(drives)
    with pytest.raises(InputError, match="not the name of a net"):
        Map.create(tmp_path / "N", "here.py:describe")
    assert not (tmp_path / "N").exists()
    with pytest.raises(InputError, match="5 dimensions, those before 768; use the net that described those"):
        a_map.add(read_sequence(drives / "b"), lambda image: np.ones(5))
    assert len(Map(tmp_path / "M")) == PLACES


@pytest.mark.slow
@pytest.mark.parametrize("name", ["map.json", ".lock"])
def test_links_are_not_followed_for_writing(name: str, a_map: Map, drives: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    target = mine / name
    if name == "map.json":
        target.write_bytes((a_map.folder / name).read_bytes())
        (a_map.folder / name).unlink()
    (a_map.folder / name).symlink_to(target)
    before = contents(mine)
    with pytest.raises(SpecError, match=f"M/{name}: is a symbolic link|M/{name}: is not a lock file"):
        a_map.add(read_sequence(drives / "b"), Thumbnailer())
    assert contents(mine) == before
    (a_map.folder / name).unlink()
    if name == "map.json":
        shutil.copy(target, a_map.folder / name)
    a_map.add(read_sequence(drives / "b"), Thumbnailer())
    assert [len(session.names) for session in Map(a_map.folder).sessions] == [10, 10]


@pytest.mark.slow
@pytest.mark.parametrize("failing", ["map.json", "loops.csv"])
def test_a_failed_add_changes_nothing(failing: str, a_map: Map, drives: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk may be full at any file; tried again, the drive is there once."""
    open_ = Path.open

    def full(self: Path, *arguments: Any, **named: Any) -> Any:
        if failing in self.name and arguments[:1] == ("wb",):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return open_(self, *arguments, **named)

    before = contents(a_map.folder)
    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", full)
        patched.setattr(Path, "write_bytes", lambda self, data: full(self, "wb").write(data))
        with pytest.raises((OSError, SpecError), match="No space left"):
            a_map.add(read_sequence(drives / "b"), Thumbnailer())
    left = contents(a_map.folder)
    assert {name: left[name] for name in before} == before
    assert not any(name.startswith("000001/") for name in left)
    assert len(Map(a_map.folder)) == PLACES
    a_map.add(read_sequence(drives / "b"), Thumbnailer())
    assert [len(session.names) for session in Map(a_map.folder).sessions] == [10, 10]


def test_a_drive_without_frames_is_not_added(a_map: Map) -> None:
    with pytest.raises(InputError, match="has no frames; nothing is added"):
        a_map.add(ImageSequence.of_files([]), Thumbnailer())
    assert len(Map(a_map.folder)) == PLACES


def test_a_missing_source_creates_no_map(drives: Path, tmp_path: Path) -> None:
    folder = tmp_path / "N"
    assert main(["map", "build", str(folder), str(drives / "a"), str(drives / "typo")]) == 1
    assert not folder.exists()
    assert main(["map", "build", str(folder), str(drives / "a"), str(drives / "b")]) == 0
    assert [len(session.names) for session in Map(folder).sessions] == [10, 10]


@pytest.mark.slow
def test_a_folder_that_the_head_does_not_list_is_not_read(a_map: Map, drives: Path) -> None:
    """A process was killed after it had written the session and before it wrote the head."""
    shutil.copytree(a_map.folder / "000000", a_map.folder / "000001")
    a_map.add(read_sequence(drives / "b"), Thumbnailer())
    assert [session.folder.name for session in Map(a_map.folder).sessions] == ["000000", "000002"]


@pytest.mark.parametrize("left", [".map.json.0a1b2c3d.unfinished", ".lock"])
def test_a_killed_build_can_be_repeated(left: str, drives: Path, tmp_path: Path) -> None:
    (tmp_path / "M").mkdir()
    (tmp_path / "M" / left).touch()
    Map.create(tmp_path / "M", "thumbnails")
    Map.create(tmp_path / "M", "thumbnails")  # killed before its first session was written

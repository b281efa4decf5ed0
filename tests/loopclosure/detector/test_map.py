"""Maps on disk: loops between sessions; a query changes nothing; a run that is killed leaves the map as it was."""

import csv
import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from loopclosure.cli import main
from loopclosure.descriptors.thumbnails import Thumbnailer
from loopclosure.detector import LoopDetector
from loopclosure.detector import map as maps
from loopclosure.detector.map import Map
from loopclosure.detector.run import remember_all, run_detector
from loopclosure.detector.verification import GeometricCheck
from loopclosure.detector.visitor import Visitor
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
    monkeypatch.setattr("loopclosure.detector.run._entry_point", lambda name: Thumbnailer)


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
    assert said[0].startswith("one visit to a place lasts")
    assert any(line.startswith("session 000000: verification: 10 of 10 matches") for line in said[first:])
    assert said[-3] == "this drive with itself: no loop"
    expected = [(f"000001/{i:03d}.png", f"000000/{i:03d}.png") for i in range(PLACES)]
    assert loops(tmp_path / "M" / "000001" / "loops.csv") == expected
    before = contents(tmp_path / "M")
    monkeypatch.setattr("loopclosure.methods.drive.MOST_PAIRS", 150)  # of two sessions, one
    assert main(["map", "query", "M", str(drives / "c"), *more, "--out", "found"]) == 0
    assert contents(tmp_path / "M") == before
    query = capsys.readouterr()
    assert "5 of 15 frames are in the map: found/loops.csv" in query.out
    assert ("2 sessions are too many to compare at once: 1 are searched" in query.err) == (index != "p.db")
    found = loops(tmp_path / "found" / "loops.csv")
    assert [(query, match.partition("/")[2]) for query, match in found] == [
        (f"{i:03d}.png", f"{i + 5:03d}.png") for i in range(5)
    ]


@pytest.mark.slow
def test_each_frame_is_verified_in_the_most_similar_session_only(
    a_map: Map, drives: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The time of a query does not grow with the number of sessions: a match and an unlike pair for each frame."""
    for _ in range(3):
        a_map.add(read_sequence(drives / "b"), Thumbnailer())
    verified, agreement = [], GeometricCheck.agreement
    monkeypatch.setattr(GeometricCheck, "agreement", lambda *given: verified.append(1) or agreement(*given))
    detector = a_map.detector(Thumbnailer())
    remember_all(detector, read_sequence(drives / "c"))
    found = [result.accepted for result in last_session(detector, own=False).results]
    assert [None if match is None else match % PLACES for match in found] == [5, 6, 7, 8, 9] + [None] * PLACES
    assert len(verified) <= 2 * len(found)
    reasons = last_session(detector, own=False).reasons
    sessions = {reason.partition(": ")[0] for reason in reasons}
    assert sessions == {f"session {number:06d}" for number in range(len(a_map.sessions))}
    assert f"session {len(a_map.sessions) - 1:06d}: no loop" in reasons  # and the reasons of those with loops


@pytest.mark.slow
def test_long_descriptors_are_projected(drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maps, "LEARNED_FROM", 9)
    monkeypatch.setattr(maps, "COMPONENTS", 8)
    opened = Map.create(tmp_path / "M", "thumbnails")
    opened.add(read_sequence(drives / "a"), Thumbnailer())
    assert (tmp_path / "M" / "projected-10" / "projection.npz").is_file()
    for again in (opened, Map(tmp_path / "M")):
        detector = again.detector(Thumbnailer())
        assert detector.descriptors.shape == (10, 8)
        visitor = Visitor(detector)
        found = [visitor.add(image).accepted for _, image, _ in read_sequence(drives / "b").frames()]
        assert found == list(range(PLACES))
    results = opened.add(read_sequence(drives / "b"), Thumbnailer())
    assert [result.accepted for result in results] == list(range(PLACES))


@pytest.mark.slow
def test_projected_descriptors_are_kept(drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maps, "LEARNED_FROM", 9)
    monkeypatch.setattr(maps, "COMPONENTS", 8)
    opened, folder = Map.create(tmp_path / "M", "thumbnails"), tmp_path / "M"
    opened.add(read_sequence(drives / "a"), Thumbnailer())
    assert {path.name for path in folder.glob("projected-*/*")} == {"000000.npy", "projection.npz"}
    expected = opened.detector(Thumbnailer()).descriptors
    path = folder / "projected-10" / "000000.npy"
    np.save(path, expected + 1)
    np.testing.assert_array_equal(Map(folder).detector(Thumbnailer()).descriptors, expected + 1)  # not computed again
    np.save(path, expected[:3])
    np.testing.assert_allclose(Map(folder).detector(Thumbnailer()).descriptors, expected, rtol=1e-4)
    opened.add(read_sequence(drives / "b"), Thumbnailer())  # twice the frames, another projection
    frames = len(opened)
    opened.add(read_sequence(drives / "c"), Thumbnailer())  # the one before stays for those who read it
    assert {path.parent.name for path in folder.glob("projected-*/*")} == {f"projected-{frames}"}


@pytest.mark.slow
def test_only_a_maps_own_old_files_are_removed(drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maps, "LEARNED_FROM", 9)
    monkeypatch.setattr(maps, "COMPONENTS", 8)
    opened, folder = Map.create(tmp_path / "M", "thumbnails"), tmp_path / "M"
    opened.add(read_sequence(drives / "a"), Thumbnailer())
    own = folder / "projected-10" / "000000.npy"
    strange = [own.with_name("notes.txt"), folder / "projected-photos" / "000000.npy", folder / "projected-3"]
    strange[1].parent.mkdir()
    for path in strange:
        path.touch()
    assert own.exists()
    opened.add(read_sequence(drives / "b"), Thumbnailer())
    opened.add(read_sequence(drives / "c"), Thumbnailer())
    assert not own.exists()
    assert all(path.exists() for path in strange)


DYING = (Path(__file__).parent / "programs" / "dying.py").read_text()


@pytest.mark.slow
def test_a_killed_command_does_not_change_the_map(a_map: Map, drives: Path, tmp_path: Path) -> None:
    before = contents(tmp_path / "M")
    words = [sys.executable, "-c", DYING, str(tmp_path / "M"), str(drives / "b")]
    assert subprocess.run(words, check=False).returncode == -signal.SIGKILL
    left = contents(tmp_path / "M")
    assert {key: value for key, value in left.items() if key in before} == before
    assert any("rows.npy" in key for key in left.keys() - before.keys())
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


@pytest.mark.parametrize(("older", "described"), [(False, "a net"), (True, "63cb899e0703cb96")])
def test_a_map_of_another_net_is_refused(
    older: bool, described: str, drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Map.create(tmp_path / "M", "default").add(read_sequence(drives / "a"), Net())
    if older:
        with np.load(tmp_path / "M" / "000000" / "frames.npz") as arrays:
            kept = {key: arrays[key] for key in arrays.files if key != "fingerprint"}
        np.savez(tmp_path / "M" / "000000" / "frames.npz", **kept)
    monkeypatch.setattr(Net, "fingerprint", described)
    Map(tmp_path / "M").detector(Net()).save(tmp_path / "d.npz")
    LoopDetector.load(tmp_path / "d.npz", Net())
    monkeypatch.setattr(Net, "fingerprint", "another")
    fault = rf"described by another net \({described}, this is another\); use the version of the package that has it, "
    with pytest.raises(InputError, match=f"M: its frames were {fault}or build the map again from its drives"):
        Map(tmp_path / "M").detector(Net())
    with pytest.raises(InputError, match=fault):
        Map(tmp_path / "M").add(read_sequence(drives / "b"), Net())
    with pytest.raises(InputError, match=f"d.npz: its frames were {fault}or start a new file"):
        LoopDetector.load(tmp_path / "d.npz", Net())
    Map(tmp_path / "M").add(read_sequence(drives / "b"), Thumbnailer())  # of a function nothing is known


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda m: (m / "map.json").write_text("{"), "M: is not a map; loopclosure map build makes one"),
        (lambda m: (m / "map.json").write_text(json.dumps({"format": 9, "describer": "x"})), "has format 9"),
        (lambda m: (m / "map.json").write_text('{"format": 1, "describer": "./x.py:f"}'), "not the name of a net"),
        (lambda m: (m / "000000" / "rows.npy").write_bytes(b"x"), "rows.npy: cannot be read"),
        (lambda m: os.truncate(m / "000000" / "rows.npy", 900), "rows.npy: cannot be read"),
        (lambda m: (m / "000000" / "points.npy").unlink(), "points.npy: no such file"),
        (lambda m: np.save(m / "000000" / "points.npy", np.zeros((3, 2), np.float32)), '"points" has shape'),
        (lambda m: np.savez(m / "000000" / "frames.npz", names=np.array(["a"])), '"rows" has shape|stamps'),
        (lambda m: np.save(m / "000000" / "rows.npy", np.full((10, 8), np.nan)), "a number that is not finite"),
        (lambda m: np.savez(older(m), mean=np.zeros(3)), "loopclosure map add makes it again"),
        (lambda m: other_width(m), "000001/rows.npy: has 5 numbers a frame, that of 000000 768; they are of one net"),
        (lambda m: pipe(m / "map.json"), "is not a regular file"),
        (lambda m: pipe(m / "000000" / "rows.npy"), "rows.npy: is not a regular file"),
        (lambda m: pipe(m / "000000" / "frames.npz"), "frames.npz: is not a regular file"),
        (lambda m: pipe(older(m)), "projection.npz: is not a regular file"),
        (lambda m: shutil.rmtree(m / "000000"), "000000/frames.npz: no such file; expected a session of a map"),
    ],
)
def test_damage_is_reported_in_one_line(damage, sentence: str, a_map: Map, tmp_path: Path) -> None:
    damage(tmp_path / "M")
    with pytest.raises(InputError, match=sentence):
        Map(tmp_path / "M").detector(Thumbnailer())


def older(folder: Path) -> Path:
    """Convert it to a map of format 1, and return the path of its projection."""
    (folder / "map.json").write_text('{"format": 1, "describer": "thumbnails"}')
    return folder / "projection.npz"


def other_width(folder: Path) -> None:
    older(folder)
    shutil.copytree(folder / "000000", folder / "000001")
    np.save(folder / "000001" / "rows.npy", np.zeros((PLACES, 5), np.float16))


def pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


@pytest.mark.parametrize("name", ["rows", "points", "descriptors"])
def test_a_file_truncated_while_open_is_an_error(name: str, a_map: Map, drives: Path) -> None:
    """A mapped one would end the process (SIGBUS)."""
    before = a_map.detector(Thumbnailer())
    os.truncate(a_map.folder / "000000" / f"{name}.npy", 200)
    with pytest.raises(InputError, match=f"{name}.npy: cannot be read .it was truncated after it was opened"):
        a_map.detector(Thumbnailer()) if name == "rows" else run_detector(before, read_sequence(drives / "b"))


def test_errors_are_reported(a_map: Map, drives: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="exists already; loopclosure map add adds to a map"):
        Map.create(tmp_path / "M", "default")
    with pytest.raises(InputError, match="is not a map"):
        Map(drives)
    with pytest.raises(InputError, match="not the name of a net"):
        Map.create(tmp_path / "N", "here.py:describe")
    assert not (tmp_path / "N").exists()
    with pytest.raises(InputError, match="ends at 65,504"):
        a_map.add(read_sequence(drives / "b"), lambda image: np.full(768, 1e5, np.float32))
    with pytest.raises(InputError, match="5 dimensions, those before 768; use the net that described those"):
        a_map.add(read_sequence(drives / "b"), lambda image: np.ones(5))
    assert len(Map(tmp_path / "M")) == PLACES


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Projections are learned from few frames and have few components."""
    monkeypatch.setattr(maps, "LEARNED_FROM", 9)
    monkeypatch.setattr(maps, "COMPONENTS", 8)


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_links_are_not_followed_for_removal(a_map: Map, drives: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "000000.npy").write_text("of the user")
    for name in ("projected-7", "projected-3"):
        (a_map.folder / name).symlink_to(mine)
    a_map.add(read_sequence(drives / "b"), Thumbnailer())
    a_map.add(read_sequence(drives / "c"), Thumbnailer())
    assert contents(mine) == {"000000.npy": b"of the user"}


@pytest.mark.slow
@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("name", ["projected-20", "map.json", "000001", ".lock"])
def test_links_are_not_followed_for_writing(name: str, a_map: Map, drives: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    target = mine / name
    if name == "map.json":
        target.write_bytes((a_map.folder / name).read_bytes())
        (a_map.folder / name).unlink()
    elif name == "projected-20":
        target.mkdir()
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
@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("failing", ["map.json", "projection.npz", "000001.npy", "loops.csv"])
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
    again = Map(a_map.folder)
    assert [len(session.names) for session in again.sessions] == [10, 10]
    expected = np.vstack([*again.sessions[1].blocks(0)]).astype(np.float32)
    assert again.projection is not None
    kept = np.vstack([*again.sessions[1].blocks(0, again.projection)])
    np.testing.assert_allclose(kept, again.projection.project(expected), rtol=1e-4, atol=1e-4)


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
@pytest.mark.usefixtures("short")
def test_readers_continue_while_a_projection_is_replaced(a_map: Map, drives: Path) -> None:
    a_map.add(read_sequence(drives / "b"), Thumbnailer())
    reader = Map(a_map.folder)
    expected = reader.detector(Thumbnailer()).descriptors
    blocks = reader.sessions[0].blocks(0, reader.projection)
    for _ in range(3):
        a_map.add(read_sequence(drives / "c"), Thumbnailer())
    np.testing.assert_allclose(next(blocks), expected[:PLACES], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(reader.detector(Thumbnailer()).descriptors, expected, rtol=1e-4, atol=1e-4)
    assert len({path.name for path in a_map.folder.glob("projected-*")}) <= 2


@pytest.mark.parametrize("images", [np.inf, np.nan, 1e300])
def test_a_projection_with_a_wrong_count_is_damaged(images: float, a_map: Map) -> None:
    arrays = {"mean": np.zeros(768), "projection": np.zeros((768, 256)), "images": np.array(images)}
    about = json.loads((a_map.folder / "map.json").read_text())
    (a_map.folder / "projected-5").mkdir()
    np.savez(a_map.folder / "projected-5" / "projection.npz", **arrays)
    (a_map.folder / "map.json").write_text(json.dumps({**about, "projection": "projected-5"}))
    with pytest.raises(InputError, match=r"projection\.npz: .*; remove it, and|projection\.npz: is not the projection"):
        Map(a_map.folder).detector(Thumbnailer())


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_a_map_of_an_older_version_can_be_extended(a_map: Map, drives: Path) -> None:
    """It named sessions by their folders, and its projection was next to them."""
    a_map.add(read_sequence(drives / "b"), Thumbnailer())
    expected = Map(a_map.folder).detector(Thumbnailer()).descriptors
    (kept,) = a_map.folder.glob("projected-*")
    (kept / "projection.npz").rename(a_map.folder / "projection.npz")
    (a_map.folder / "map.json").write_text(json.dumps({"format": 1, "describer": "thumbnails"}))
    old = Map(a_map.folder)
    assert len(old) == 2 * PLACES
    np.testing.assert_array_equal(old.detector(Thumbnailer()).descriptors, expected)
    old.add(read_sequence(drives / "c"), Thumbnailer())
    new = Map(a_map.folder)
    assert [len(session.names) for session in new.sessions] == [10, 10, 15]
    assert json.loads((a_map.folder / "map.json").read_text())["format"] == 2
    assert not (a_map.folder / "projection.npz").exists()
    assert new.detector(Thumbnailer()).descriptors.shape == (35, 8)

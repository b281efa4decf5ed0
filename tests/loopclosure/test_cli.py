"""The commands as a user calls them: what they write, and one line for what is wrong."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from lmdb_build.cli import main as lmdb_build_main
from loopclosure import Thumbnailer, close, detect, evaluate
from loopclosure.cli import main
from loopclosure.places.frames import read_bgr
from paths import ROOT

THUMBNAILS = "loopclosure.descriptors.thumbnails:Thumbnailer"


def thumbnail(image: np.ndarray) -> np.ndarray:
    return Thumbnailer()(image)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A rendered walk of two laps with depth, and a file of features of its images."""
    folder = tmp_path_factory.mktemp("rendered")
    words = ["walk", str(folder / "walk"), "--frames", "70", "--size", "80x60", "--depth"]
    assert lmdb_build_main(words) == 0
    walk = folder / "walk" / "walk_1"
    images = sorted((walk / "rgb").iterdir())
    rows = np.array([thumbnail(read_bgr(path)) for path in images], np.float32)
    np.savez(folder / "f.npz", features=rows, names=np.array([path.name for path in images]))
    return walk, folder / "f.npz"


@pytest.mark.slow
def test_evaluate(two_laps, two_laps_features, tmp_path, capsys):
    line = f"evaluate tum:{two_laps} --method thumbnails --method net=features:{two_laps_features}"
    line += f" --out {tmp_path / 'r'}"
    assert main([*line.split(), "--title", "Round trip"]) == 0
    printed = capsys.readouterr().out
    assert "thumbnails" in printed
    assert "less than 10 s apart excluded" in printed
    assert f"report: {tmp_path / 'r' / 'report.html'}" in printed
    summary = json.loads((tmp_path / "r" / "report.json").read_text())
    assert [m["name"] for m in summary["methods"]] == ["thumbnails", "net"]
    assert summary["command"].startswith("loopclosure evaluate tum:")


@pytest.mark.slow
def test_evaluate_the_whole_system_on_another_recording(two_laps, two_laps_features, tmp_path, capsys):
    features = f"features:{two_laps_features}"
    line = f"evaluate {two_laps},start=20,references={two_laps} --out {tmp_path}"
    line += f" --method verified+{features} --method verified+seqslam+{features}"
    line += " --set verified.k=2"
    assert main(line.split()) == 0
    assert "best match; 45 degrees" in capsys.readouterr().out
    summary = json.loads((tmp_path / "report.json").read_text())
    assert (summary["queries"], summary["references"]) == (20, 40)
    assert "turned less than 45 degrees" in summary["wide_angle"]["truth"]
    for method in summary["methods"]:
        assert {"best match of each query", "best match of each query; 45 degrees"} < set(method["figures"])
        assert set(method["curves"]) == set(method["figures"])


@pytest.mark.slow
def test_evaluate_trains_on_other_images(two_laps, tmp_path, capsys):
    line = f"evaluate {two_laps},start=20 --exclude-seconds 0 --max-angle 19 --train {two_laps},stop=50%,stride=2"
    assert main([*line.split(), "--method", "bow", "--set", "bow.words=20", "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "report.json").read_text())
    assert summary["training"] == "10 images of two_laps"
    assert "vocabulary" not in summary["methods"][0]["milliseconds_a_frame"]


def loops_in(path: Path) -> dict[int, int]:
    with path.open() as stream:
        return {int(row["query_id"]): int(row["match_id"]) for row in csv.DictReader(stream)}


@pytest.mark.slow
@pytest.mark.parametrize("describe", ["FEATURES", thumbnail], ids=["features", "function"])
def test_detect_is_a_function_and_a_command(describe, rendered, tmp_path, capsys):
    """Both give the same loops, from the same frames; the command says how many, where the page is, what is next."""
    walk, features = rendered
    describe = str(features) if describe == "FEATURES" else describe
    found = detect(walk, tmp_path / "function", describe=describe, exclude_seconds=5.0)
    name = f"{__file__}:thumbnail" if callable(describe) else describe
    words = ["detect", str(walk), "--describe", name, "--exclude-seconds", "5", "--out", str(tmp_path / "command")]
    assert main(words) == 0
    for file in ("loops.csv", "loops.g2o"):
        assert (tmp_path / "command" / file).read_bytes() == (tmp_path / "function" / file).read_bytes()
    assert {loop.query: loop.match for loop in found.loops} == loops_in(tmp_path / "command" / "loops.csv")
    assert len(found.loops) > 20
    (loops, page, following) = capsys.readouterr().out.splitlines()
    assert loops == f"{len(found.loops)} loops in {len(found.results)} frames: {tmp_path / 'command' / 'loops.csv'}"
    assert page == f"report: {tmp_path / 'command' / 'report.html'}"
    assert f"loopclosure close {walk} --loops " in following
    chosen = (tmp_path / "command" / "chosen.txt").read_text().replace("/command/", "/function/")
    assert chosen.splitlines() == found.reasons
    assert "are the same place by their poses (2 m, 15 degrees)" in chosen


@pytest.mark.slow
def test_close_is_a_function_and_a_command(rendered, tmp_path, capsys):
    walk, features = rendered
    detect(walk, tmp_path, describe=features)
    closed = close(walk, tmp_path / "loops.csv", tmp_path / "function", drift=2.0, seed=3)
    words = ["close", str(walk), "--loops", str(tmp_path / "loops.csv"), "--drift", "2", "--seed", "3"]
    assert main([*words, "--out", str(tmp_path / "command")]) == 0
    for file in ("closed.g2o", "closed.txt", "odometry.txt", "loops.csv"):
        by_function, by_command = ((tmp_path / door / file).read_text() for door in ("function", "command"))
        assert by_function == by_command.replace("command", "function")
    assert f"{closed.accepted.sum()} of {len(closed.loops)} loops used" in capsys.readouterr().out


@pytest.mark.slow
def test_evaluate_is_a_function_and_a_command(two_laps, tmp_path):
    found = evaluate(two_laps, ["thumbs=thumbnails"], tmp_path / "function", exclude_frames=3, max_angle=30, seed=5)
    words = ["evaluate", str(two_laps), "--method", "thumbs=thumbnails", "--exclude-frames", "3", "--max-angle", "30"]
    assert main([*words, "--seed", "5", "--out", str(tmp_path / "command")]) == 0
    by_function, by_command = (
        json.loads((tmp_path / door / "report.json").read_text()) for door in ("function", "command")
    )
    for report in (by_function, by_command):
        del report["command"], report["methods"][0]["seconds"], report["methods"][0]["milliseconds_a_frame"]
    assert by_function == by_command
    assert by_function["methods"][0]["figures"]["all pairs"] == pytest.approx(
        found.outcomes[0].measures["all pairs"], abs=1e-5
    )


def drive_that_comes_back(folder: Path) -> Path:
    """Write 120 pictures that change slowly, and 80 of them again, darker; frame 120 shows what frame 20 shows."""
    steps = np.random.default_rng(0).integers(0, 256, (126, 24, 32)).astype(np.float64)
    road = [steps[i : i + 6].mean(axis=0) for i in range(120)]
    drive = folder / "drive"
    drive.mkdir()
    for i, image in enumerate([*road, *(0.8 * image for image in road[20:100])]):
        cv2.imwrite(str(drive / f"{i:03d}.png"), cv2.resize(image, (64, 48)))
    return drive


@pytest.mark.slow
def test_detect_chooses_the_threshold_automatically(tmp_path, capsys):
    drive = drive_that_comes_back(tmp_path)
    assert main(["detect", str(drive), "--describe", THUMBNAILS, "--out", str(tmp_path / "found")]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert " loops in 200 frames: " in printed[0]
    page = (tmp_path / "found" / "report.html").read_text()
    count = int(printed[0].split()[0])
    assert f"<h1>{count} of 200 frames show a place that was seen before</h1>" in page
    assert (page.count('<div class="pair found">'), page.count('<div class="pair rejected">')) == (7, 3)
    for reason in (tmp_path / "found" / "chosen.txt").read_text().splitlines():
        assert reason in page
    loops = loops_in(tmp_path / "found" / "loops.csv")
    assert len(loops) > 60
    assert all(abs(query - 100 - match) <= 5 for query, match in loops.items())


@pytest.mark.slow
def test_unreadable_images_are_skipped(tmp_path, capsys):
    """Two of 200: loops, map and report have the others; a folder without one image is refused."""
    folder = drive_that_comes_back(tmp_path)
    for number in (3, 140):
        (folder / f"{number:03d}.png").write_bytes(b"")
    describe = ["--describe", THUMBNAILS]
    assert main(["detect", str(folder), *describe, "--out", str(tmp_path / "found")]) == 0
    printed = capsys.readouterr()
    assert "2 of 200 images cannot be read and are left out: 003.png, 140.png" in printed.err
    assert " loops in 198 frames" in printed.out
    with (tmp_path / "found" / "loops.csv").open() as stream:
        names = {int(row["query_name"][:3]): int(row["match_name"][:3]) for row in csv.DictReader(stream)}
    assert len(names) > 50
    assert all(abs(query - 100 - match) <= 5 for query, match in names.items())
    (folder / "only").mkdir()
    (folder / "only" / "0.png").write_bytes(b"no picture")
    assert main(["detect", str(folder / "only"), *describe, "--out", str(tmp_path / "none")]) == 1
    assert "0.png: is not a readable image" in capsys.readouterr().err


@pytest.mark.slow
def test_all_ways_give_the_same_loops(tmp_path, capsys):
    """A camera passes a wall, and a part of it once more: a folder, a list, videos, two traverses, a map."""
    rng = np.random.default_rng(1)
    wall = np.full((128, 1600, 3), 128, np.uint8)
    for _ in range(1600):
        center = tuple(int(c) for c in rng.integers(0, (1600, 128)))
        cv2.circle(wall, center, int(rng.integers(2, 14)), rng.integers(0, 256, 3).tolist(), -1)
    wall = cv2.GaussianBlur(wall, (0, 0), 1.0)
    places = [(20 * i, 0) for i in range(70)] + [(20 * i + 5, 6) for i in range(20, 60)]
    (tmp_path / "drive").mkdir()
    film = cv2.VideoWriter(str(tmp_path / "drive.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 2, (160, 112))
    for number, (x, y) in enumerate(places):
        image = wall[y : y + 112, x : x + 160]
        cv2.imwrite(str(tmp_path / "drive" / f"{number:03d}.png"), image)
        film.write(image)
    film.release()
    names = sorted(str(path) for path in (tmp_path / "drive").iterdir())
    (tmp_path / "list.txt").write_text("\n".join(names) + "\n")
    for part, lines in (("first", names[:70]), ("second", names[70:])):
        (tmp_path / part).mkdir()
        for name in lines:
            shutil.copy(name, tmp_path / part)
    small = ["--describe", "small"]
    found = {}
    for door, line in {
        "folder": ["detect", str(tmp_path / "drive")],
        "list": ["detect", str(tmp_path / "list.txt")],
        "mp4": ["detect", str(tmp_path / "drive.mp4")],
        "video": ["watch", "--video", str(tmp_path / "drive.mp4")],
    }.items():
        assert main([*line, *small, "--out", str(tmp_path / door)]) == 0
        found[door] = loops_in(tmp_path / door / "loops.csv")
    build = ["map", "build", str(tmp_path / "M"), str(tmp_path / "drive"), *small]
    assert main(build) == 0
    found["map"] = loops_in(tmp_path / "M" / "000000" / "loops.csv")
    assert main(["map", "build", str(tmp_path / "N"), str(tmp_path / "first"), *small]) == 0
    assert main(["map", "query", str(tmp_path / "N"), str(tmp_path / "second"), "--out", str(tmp_path / "query")]) == 0
    found["query"] = {query + 70: match for query, match in loops_in(tmp_path / "query" / "loops.csv").items()}
    capsys.readouterr()
    for loops in found.values():
        assert all(abs(places[query][0] - places[match][0]) <= 45 for query, match in loops.items())
        assert len(loops) >= 36
    for door, loops in found.items():
        assert len(set(loops) & set(found["folder"])) >= 0.95 * len(set(loops) | set(found["folder"])), door
    assert found["folder"] == found["list"]


def expanded(line: str, **names: object) -> list[str]:
    """Split a command line, with the names in capitals replaced at the beginning of its parts."""
    parts = line.split()
    for name, value in names.items():
        parts = [part.replace(name, str(value)) for part in parts]
    return parts


@pytest.mark.parametrize(
    ("sentence", "line"),
    [
        ("NOWHERE: no such folder", "evaluate NOWHERE --method thumbnails --out OUT"),
        ('unknown method "magic"', "evaluate LAPS --method magic --out OUT"),
        ("has no ground truth of which frames show the same place", "evaluate LAPS/rgb --method thumbnails --out OUT"),
        ("no judged pair shows the same place", "evaluate LAPS,start=50% --method thumbnails --out OUT"),
        ("test images are training images", "evaluate LAPS --method bow --train LAPS --out OUT"),
        ("NOWHERE.npz: no such file", "evaluate LAPS --method features:NOWHERE.npz --out OUT"),
        ("cannot be read", "detect NOWHERE --out OUT"),
        ("expected module:function", "detect LAPS --describe nothing: --out OUT"),
        ("FEATURES: cannot be written: Not a directory", "detect LAPS --out FEATURES"),
        ("cannot exclude 0 frames, nan s", "evaluate LAPS --exclude-seconds nan --method thumbnails --out OUT"),
    ],
)
def test_an_error_is_one_line_with_status_1(line, sentence, two_laps, two_laps_features, tmp_path, capsys):
    names = {"LAPS": two_laps, "OUT": tmp_path / "out", "FEATURES": two_laps_features}
    assert main(expanded(line, **names)) == 1
    (printed,) = capsys.readouterr().err.strip().splitlines()
    assert sentence.replace("FEATURES", str(two_laps_features)) in printed


def test_a_folder_with_poses_but_no_times_of_its_images_says_what_is_missing(tmp_path, capsys):
    (tmp_path / "a.png").write_bytes(b"")
    (tmp_path / "groundtruth.txt").write_text("0 0 0 0 0 0 0 1\n")
    assert main(["evaluate", str(tmp_path), "--method", "thumbnails", "--out", str(tmp_path / "out")]) == 1
    expected = f"{tmp_path}: has groundtruth.txt, but no rgb.txt; expected the time and the file of each image"
    assert expected in capsys.readouterr().err


@pytest.mark.parametrize(
    ("sentence", "line"),
    [
        ('a sequence has no setting "camera"', "evaluate LAPS,camera=left --method thumbnails --out OUT"),
        ("needs ,truth=", "evaluate images:LAPS --method thumbnails --out OUT"),
        (
            "--max-angle is for sequences with poses, not for ",
            "evaluate pairs:LAPS --max-angle 60 --method thumbnails --out OUT",
        ),
        ("--exclude-frames cannot", "evaluate LAPS,references=LAPS --exclude-seconds 3 --method thumbnails --out OUT"),
        ("--metric is a setting of the saved", "watch --video LAPS --resume OUT --metric cosine --out OUT"),
    ],
)
def test_contradictory_options_are_one_line_with_status_2(
    line, sentence, two_laps, two_laps_features, tmp_path, capsys
):
    names = {"LAPS": two_laps, "OUT": tmp_path / "out", "FEATURES": two_laps_features}
    assert main(expanded(line, **names)) == 2
    (printed,) = capsys.readouterr().err.strip().splitlines()
    assert sentence in printed


@pytest.mark.slow
def test_names_that_are_not_utf8_are_escaped(two_laps, tmp_path):
    source, out = tmp_path / "caf\udce9", tmp_path / "out\udce9"
    shutil.copytree(two_laps, source)
    (source / "rgb.txt").unlink()
    poses = "\n".join(f"{k} {5 * (k % 20)} 0 0 0 0 0 1" for k in range(40))
    (tmp_path / "poses.txt").write_text(poses)
    words = [f"images:{source / 'rgb'},poses={tmp_path / 'poses.txt'}", "--exclude-frames", "5"]
    words += ["--method", "\udce9=thumbnails", "--title", "\udce9", "--out", str(out)]
    assert main(["evaluate", *words]) == 0
    assert "out\\udce9" in (out / "report.html").read_text()


@pytest.mark.parametrize(
    "line",
    [
        "",
        "evaluate",
        "detect x --threshold 1 --out y",
        "detect x --with width --out y",
        "watch x --out y",
        "evaluate --camera front",
    ],
)
def test_wrong_usage_is_status_2(line, capsys):
    assert main(line.split()) == 2
    assert "usage: loopclosure" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ("argument --seed: found -1, expected a number from 0 to 2147483647", "evaluate --seed -1"),
        ("argument --seed: found 99999999999, expected a number from 0 to", "close x --seed 99999999999"),
        ("argument --max-distance: found nan, expected a number above 0", "evaluate --max-distance nan"),
        ("argument --max-angle: found nan, expected a number above 0", "evaluate --max-angle nan"),
    ],
)
def test_invalid_numbers_are_wrong_usage(words, said, capsys):
    assert main(words.split()) == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_ctrl_c_is_one_line_with_status_130(two_laps, tmp_path):
    """Interrupted while it reads: a pipe that nobody writes into."""
    os.mkfifo(tmp_path / "features.npz")
    shutil.copytree(two_laps / "rgb", tmp_path / "images")
    code = """
import sys
from loopclosure.cli import main
sys.exit(main(["detect", "images", "--describe", "features.npz", "--out", "out"]))
"""
    paths = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, stderr=subprocess.PIPE, text=True, env=paths)
    with process, open(tmp_path / "features.npz", "wb"):  # open waits until it is opened for reading
        process.send_signal(signal.SIGINT)
        _, printed = process.communicate(timeout=300)
    assert process.returncode == 130
    assert printed == "interrupted\n"

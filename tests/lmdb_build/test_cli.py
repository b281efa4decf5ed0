"""The command lmdb-build: from a walk to lists and a picture, and what it says to wrong input."""

import re
from pathlib import Path

import pytest

from lmdb_build.cli import main
from lmdb_build.pairs.list_file import read_pair_list, read_settings
from places_layouts import path, tum_rows, write_benchmark, write_euroc, write_kitti, write_video


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("walks")
    command = ["walk", str(out), "--sequences", "2", "--frames", "60", "--size", "48x36", "--laps", "2"]
    assert main(command) == 0
    return out


def pairs(walks: Path, *more: str) -> list[str]:
    return ["pairs", str(walks / "walk_1"), str(walks / "walk_2"), "--test", "0", *more]


@pytest.mark.slow
def test_from_a_walk_to_lists_and_a_picture(walks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "lists"
    command = pairs(
        walks, "--out", str(out), "--train", "60", "--val", "20", "--different-scenes", "--root", str(walks)
    )
    assert main(command) == 0
    said = capsys.readouterr()
    assert "60 images with a pose, 0 without one left out" in said.out
    assert "positive, same sequence" in said.out
    assert "nobody said" not in said.err
    listed = read_pair_list(out / "train.txt")
    assert len(listed) == 60
    assert all((walks / pair.first).is_file() and (walks / pair.second).is_file() for pair in listed)
    assert not (out / "test.txt").exists()
    assert main(["sheet", str(out / "train.txt"), str(tmp_path / "sheet.png")]) == 0
    assert (tmp_path / "sheet.png").stat().st_size > 10_000


@pytest.mark.slow
def test_printed_commands_work_with_convert(walks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a folder"
    assert main(pairs(walks, "--out", str(out), "--train", "20", "--val", "10", "--different-scenes")) == 0
    said = capsys.readouterr().out
    assert "lmdb-build" not in said  # nothing looks as if it had run
    found = re.fullmatch(r"wrote (.+); their image names are relative to (.+)", said.splitlines()[-1])
    assert found
    lists, root = found[1].split(", "), found[2]
    assert lists == [f"{out}/train.txt", f"{out}/val.txt"]
    for each in lists:
        assert main(["convert", root, each, each.replace(".txt", "_lmdb")]) == 0
    assert main(["mean", f"{out}/train_lmdb", f"{out}/mean.binaryproto"]) == 0
    assert (out / "mean.binaryproto").stat().st_size > 1000


def test_a_warning_for_undeclared_scenes(walks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(pairs(walks, "--out", str(tmp_path), "--train", "60", "--val", "0")) == 0
    assert "warning: train: " in capsys.readouterr().err


def test_named_sequences_and_shared_frames(walks: Path, tmp_path: Path) -> None:
    command = pairs(walks, "--out", str(tmp_path), "--train", "40", "--val", "20", "--val-sequences", "walk_2")
    assert main([*command, "--negatives", "same_sequence", "--same-frame", "walk_1,walk_2"]) == 0
    assert {pair.first.split("/")[0] for pair in read_pair_list(tmp_path / "val.txt")} == {"walk_2"}
    assert read_settings(tmp_path / "val.txt")["one frame of reference"] == "walk_1 walk_2"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["pairs", "{0}/nowhere", "--out", "{1}"], "no such folder"),
        (["pairs", "{0}/walk_1", "--out", "{1}", "--train", "3"], "even, not 3"),
        (["pairs", "{0}/walk_1", "--out", "{1}", "--train", "100000"], "--at-most"),
        (["pairs", "folders:{0}/walk_1,references={1}", "--out", "{1}"], "contains no images"),
        (["sheet", "{1}/none.txt", "{1}/x.png"], "cannot be read"),
        (["walk", "{0}"], "holds a sequence already"),
        (["walk", "{1}/w", "--rooms", "5"], "even number of rooms"),
        (["walk", "{0}/walk_1/rgb.txt"], "Not a directory"),
    ],
)
def test_an_error_of_the_user_is_one_line_with_status_1(
    walks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    assert main([argument.format(walks, tmp_path) for argument in arguments]) == 1
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    "line",
    [
        "",
        "pairs --out x",
        "pairs a folders:b,references=c --out x",
        "pairs images:m --out x",
        "walk x --size 320",
        "walk x --sequences 0",
        "walk x --seed -1",
        "pairs a --out x --shares 1,2",
        "pairs a --out x --max-distance nan",
        "pairs a --out x --max-angle -1",
        "pairs a --out x --seed -1",
        "sheet a x.png --seed -1",
    ],
)
def test_wrong_usage_is_status_2(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(line.split()) == 2
    assert not list(tmp_path.iterdir())


def lists(out: Path, line: str) -> list[tuple[str, str, int]]:
    counts = "--train 20 --val 0 --test 0 --at-most"
    assert main(["pairs", *line.split(), *counts.split(), "--out", str(out)]) == 0
    return [(pair.first, pair.second, pair.label) for pair in read_pair_list(out / "train.txt")]


@pytest.mark.slow
def test_pairs_accepts_all_kinds_of_data_sets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses = tmp_path / "poses.txt"
    poses.write_text(tum_rows(path()))
    euroc, kitti = write_euroc(tmp_path / "e"), write_kitti(tmp_path / "k")
    video = write_video(tmp_path / "v.avi")
    by_pose = [
        f"{euroc}",
        f"euroc:{euroc}",
        f"kitti:{kitti}",
        f"video:{video},poses={poses}",
        f"images:{kitti / 'image_0'},poses={poses},pose-form=tum",
    ]
    for number, line in enumerate(by_pose):
        chosen = lists(tmp_path / f"out{number}", f"{line} --min-gap 10")
        assert {label for _, _, label in chosen} == {0, 1}
        for first, second, label in chosen:
            a, b = (int(Path(name).stem[:10]) for name in (first, second))  # EuRoC's names are nanoseconds
            assert label == (abs(a - b) == 24)
    assert "48 images with a pose, 0 without one left out" in capsys.readouterr().out


def test_pairs_of_a_benchmark_are_a_query_and_a_reference(tmp_path: Path) -> None:
    folder = write_benchmark(tmp_path / "b")
    for line in (
        f"nordland:{folder}",
        f"traverses:{folder}/query,references={folder}/ref,truth={folder}/ground_truth.json --root {folder}",
    ):
        chosen = lists(tmp_path / "out", line)
        assert {label for _, _, label in chosen} == {0, 1}
        for first, second, label in chosen:
            ends = {Path(name).parent.name: int(Path(name).stem) for name in (first, second)}
            assert label == (0 <= ends["ref"] - ends["query"] <= 2)


def test_traverses_need_a_mask_and_poses_are_for_sequences(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["pairs", "traverses:a,references=b", "--out", "o"]) == 2
    assert "traverses:a,references=b needs ,truth=" in capsys.readouterr().err
    assert main(["pairs", "nordland:a,poses=p.txt", "--out", "o"]) == 2
    assert 'nordland has no setting "poses"' in capsys.readouterr().err
    assert main(["pairs", "images:a,truth=b.npy", "--out", "o", "--max-angle", "9"]) == 2
    assert "--max-angle is for sequences with poses, not for images" in capsys.readouterr().err

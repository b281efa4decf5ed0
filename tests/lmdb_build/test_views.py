"""Two views of each place: what stands in a batch together, what a view shows, and the command that writes them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from lmdb_build.cli import main
from lmdb_build.light import change_light
from lmdb_build.pairs.list_file import read_pair_list
from lmdb_build.pairs.runs import Runs
from lmdb_build.views import Batches, choose_views, cut_view
from loopclosure.errors import InputError


def runs_of(tracks: int = 5, images: int = 40) -> Runs:
    names = [f"{track}/{image}.jpg" for track in range(tracks) for image in range(images)]
    return Runs(names, np.repeat(np.arange(tracks), images), np.tile(np.arange(images, dtype=float), tracks))


def test_a_batch_has_different_places_of_few_runs() -> None:
    runs = runs_of(images=80)
    first, second = choose_views(runs, Batches(count=20, size=24), np.random.default_rng(0))
    assert len(first) == len(second) == 480
    for batch in first.reshape(20, 24):
        tracks = runs.tracks[batch]
        assert np.bincount(tracks).max() == 8
        assert len(np.unique(tracks)) <= 4
        for track in np.unique(tracks):
            stamps = np.sort(runs.stamps[batch[tracks == track]])
            assert np.diff(stamps).min() > 4
    assert len(np.unique(first)) > 200  # not the same few again


def test_the_second_image_is_the_first_or_near_it_in_its_run() -> None:
    runs = runs_of()
    first, second = choose_views(runs, Batches(count=30, size=12), np.random.default_rng(0))
    assert np.all(runs.tracks[first] == runs.tracks[second])
    gaps = np.abs(runs.stamps[first] - runs.stamps[second])
    assert set(gaps) == {0, 1}
    assert 0.3 < np.mean(gaps > 0) < 0.5


def test_a_batch_uses_one_part_of_a_run() -> None:
    runs = runs_of(tracks=5, images=200)
    first, _ = choose_views(runs, Batches(count=40, size=12, window=30), np.random.default_rng(0))
    starts = []
    for batch in first.reshape(40, 12):
        for track in np.unique(runs.tracks[batch]):
            stamps = runs.stamps[batch[runs.tracks[batch] == track]]
            assert np.ptp(stamps) <= 30
            starts.append(stamps.min())
    assert np.ptp(starts) > 100


def test_long_runs_are_drawn_more_often() -> None:
    names = [f"{number}.jpg" for number in range(100)]
    runs = Runs(names, np.repeat([0, 1, 2], [80, 10, 10]), np.arange(100.0))
    first, _ = choose_views(runs, Batches(count=300, size=1), np.random.default_rng(0))
    assert 0.7 < np.mean(runs.tracks[first] == 0) < 0.9


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"size": 100}, "5 runs gave [23][0-9], at most 8 of each, more than 4 s apart; lower --size"),
        ({"size": 0}, "--size must be at least 1, not 0"),
        ({"window": 0.0}, "--window must be more than 0, not 0"),
    ],
)
def test_batches_that_cannot_be_made_are_refused(settings: dict, words: str) -> None:
    batches = Batches(**{"count": 1, **settings})
    with pytest.raises(InputError, match=words):
        choose_views(runs_of(), batches, np.random.default_rng(0))


def test_two_views_of_one_point_overlap() -> None:
    # Colors that say where a pixel was: blue its row, green its column.
    rows, columns = np.mgrid[0:120, 0:200]
    image = np.dstack([rows, columns, np.zeros_like(rows)]).astype(np.uint8)
    rng = np.random.default_rng(3)
    centers = []
    for about in ([0.0, 0.0], [1.0, 1.0]):
        views = [cut_view(image, (64, 48), np.array(about), rng) for _ in range(20)]
        assert all(view.shape == (48, 64, 3) and view.dtype == np.uint8 for view in views)
        assert len({view.tobytes() for view in views}) == 20
        centers.append(np.mean([view[20:28, 28:36, 1].mean() for view in views]))
    assert centers[1] > centers[0] + 20


def test_the_strength_of_a_view_is_adjustable() -> None:
    image = cv2.resize(np.random.default_rng(2).integers(0, 255, (12, 16, 3), np.uint8), (320, 240))

    def spread(viewpoint: float) -> float:
        rng = np.random.default_rng(3)
        views = [cut_view(image, (64, 48), np.array([0.5, 0.5]), rng, viewpoint) for _ in range(40)]
        return float(np.std(views, axis=0).mean())

    weak, usual, strong = (spread(viewpoint) for viewpoint in (0.0, 1.0, 2.0))
    assert weak < 0.7 * usual < 0.7 * strong


@pytest.mark.slow
def test_the_command_writes_views_and_their_list(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    lines = ["image,run,second"]
    for run in "ab":
        (tmp_path / "src" / run).mkdir(parents=True)
        for number in range(12):
            picture = cv2.resize(rng.integers(0, 255, (6, 8, 3), np.uint8), (80, 60))
            cv2.imwrite(str(tmp_path / "src" / run / f"{number}.jpg"), picture)
            lines.append(f"{run}/{number}.jpg,{run},{number}")
    index = tmp_path / "src" / "index.csv"
    index.write_text("\n".join(lines) + "\n")
    command = ["views", "--batches", "3", "--size", "4", "--view-size", "32x24"]
    by_index = [*command, f"index:{index},track=run,time=second"]
    assert main([*by_index, "--out", str(tmp_path / "one")]) == 0
    said = capsys.readouterr().out
    assert "3 batches of 4 pairs" in said
    assert said.endswith(f"relative to {tmp_path}/\n")
    assert main(["convert", f"{tmp_path}/", str(tmp_path / "one.txt"), str(tmp_path / "one_lmdb")]) == 0
    assert (tmp_path / "one_lmdb" / "data.mdb").is_file()
    listed = read_pair_list(tmp_path / "one.txt")
    assert [pair.label for pair in listed] == [1] * 12
    views = [cv2.imread(str(tmp_path / name)) for pair in listed for name in (pair.first, pair.second)]
    assert all(view is not None and view.shape == (24, 32, 3) for view in views)

    assert main([*by_index, "--out", str(tmp_path / "again" / "one")]) == 0
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "again" / "one" / path.name).read_bytes()

    folders = [str(tmp_path / "src" / run) for run in "ab"]
    assert main([*command, *folders, "--out", str(tmp_path / "two")]) == 0
    assert len(read_pair_list(tmp_path / "two.txt")) == 12

    assert main([*by_index, "--calm", "2", "--out", str(tmp_path / "five")]) == 1
    assert "--calm must be 0 to 1, not 2" in capsys.readouterr().err

    assert main([*by_index, "--viewpoint", "4", "--out", str(tmp_path / "five")]) == 1
    assert "--viewpoint must be 0 to 3, not 4" in capsys.readouterr().err

    both = [*by_index, folders[0], "--step", "0.5", "--out", str(tmp_path / "both")]
    assert main(both) == 0
    assert len(read_pair_list(tmp_path / "both.txt")) == 12
    assert "source: 36 images of 3 runs" in (tmp_path / "both.txt").read_text()

    capsys.readouterr()
    assert main([*command, *folders, "--size", "9", "--out", str(tmp_path / "three")]) == 1
    assert "cannot be made" in capsys.readouterr().err
    assert not (tmp_path / "three").exists()
    index.write_text("\n".join(lines).replace("a,3", "a,x") + "\n")
    assert main([*by_index, "--out", str(tmp_path / "four")]) == 1
    assert 'index.csv:5:1: expected a number in column second, found "x"' in capsys.readouterr().err


@pytest.mark.parametrize("more", [[], ["folder", "index:x.csv"], ["index:x.csv,track=a"], ["folder", "--step", "0"]])
def test_the_source_has_its_full_name(more: list[str]) -> None:
    assert main(["views", "--out", "out", *more]) == 2


@pytest.fixture
def view() -> np.ndarray:
    rng = np.random.default_rng(1)
    return cv2.resize(rng.integers(40, 216, (6, 8, 3), np.uint8), (64, 48), interpolation=cv2.INTER_CUBIC)


def test_a_view_depends_only_on_the_generator(view: np.ndarray) -> None:
    other, before = view[::-1].copy(), view.copy()
    found = [change_light(view, lambda: other, np.random.default_rng(seed)) for seed in range(40)]
    assert all(each.shape == view.shape and each.dtype == np.uint8 for each in found)
    assert len({each.tobytes() for each in found}) == 40
    np.testing.assert_array_equal(found[7], change_light(view, lambda: other, np.random.default_rng(7)))
    np.testing.assert_array_equal(view, before)


def test_most_views_can_still_be_recognized(view: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    like = [
        np.corrcoef(view.mean(axis=2).ravel(), change_light(view, lambda: view, rng).mean(axis=2).ravel())[0, 1]
        for _ in range(200)
    ]
    assert np.median(like) > 0.5
    assert np.mean(np.array(like) < 0.95) > 0.3


def test_a_small_image_in_front_is_cropped(view: np.ndarray) -> None:
    dark = np.zeros((5, 7, 3), np.uint8)
    assert any((change_light(view, lambda: dark, np.random.default_rng(seed)) == 0).any() for seed in range(40))


def test_weak_views_keep_their_colors(view: np.ndarray) -> None:
    gray = np.repeat(view[..., :1], 3, axis=2)
    other = np.dstack([np.full((48, 64), 255), np.zeros((48, 64)), np.zeros((48, 64))]).astype(np.uint8)
    for calm, most, least in ((1.0, 0, 0), (0.0, 200, 30)):
        found = [change_light(gray, lambda: other, np.random.default_rng(seed), calm) for seed in range(100)]
        colored = sum(bool(np.ptp(each.astype(int), axis=2).any()) for each in found)
        assert least <= colored <= most

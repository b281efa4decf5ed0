"""The synthetic walk: true geometry, places really seen again, all from the seed."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lmdb_build.walk.house import House, Quad, Room, build_house
from lmdb_build.walk.render import Camera, Light, Renderer
from lmdb_build.walk.sequence import Walk, write_walk
from loopclosure.errors import InputError
from loopclosure.places.frames import read_depth
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.pose_files import read_poses
from loopclosure.places.same_place import same_place_matrix
from loopclosure.places.sequences import read_sequence

pytestmark = pytest.mark.slow

SMALL = Walk(frames=150, width=64, height=48, laps=3, seed=7)
CAMERA = Camera(160, 120, 131.25)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("walk") / "walk_1"
    assert len(list(write_walk(folder, SMALL))) == SMALL.frames
    return folder


@pytest.fixture(scope="module")
def sequence(folder: Path) -> ImageSequence:
    return read_sequence(folder, "tum").with_poses()


def plain_light(rooms: int = 1) -> Light:
    return Light(np.ones(3), np.zeros((rooms, 3)), np.zeros((rooms, 3)))


def flat_house(*quads: Quad) -> House:
    return House(list(quads), [Room(0, (-5.0, -5.0, 5.0, 5.0))], np.zeros((1, 2)), 1.0)


def facing_quad(distance: float, size: float, texture: np.ndarray) -> Quad:
    """A square before a camera at the origin with no rotation (looking along +z, y down)."""
    origin = np.array([-size / 2, -size / 2, distance])
    return Quad(origin, np.array([size, 0, 0.0]), np.array([0, size, 0.0]), texture, 0)


def test_a_walk_has_tums_layout_and_a_pose_for_each_frame(folder: Path, sequence: ImageSequence) -> None:
    assert len(sequence) == SMALL.frames
    assert all(path.is_file() for path in sequence.paths)
    assert sequence.stamps is not None
    stamps = read_poses(folder / "groundtruth.txt").stamps
    assert stamps is not None
    assert np.diff(stamps).mean() * 9 < np.diff(sequence.stamps).mean()
    picture = cv2.imread(str(sequence.paths[0]))
    assert picture is not None
    assert picture.shape == (SMALL.height, SMALL.width, 3)


def test_a_walk_of_few_frames_has_a_pose_for_each_of_them(tmp_path: Path) -> None:
    list(write_walk(tmp_path / "few", replace(SMALL, frames=6)))
    assert read_sequence(tmp_path / "few", "tum").known.all()


@pytest.mark.slow
def test_the_seed_determines_the_bytes_of_a_walk(folder: Path, tmp_path: Path) -> None:
    short = replace(SMALL, frames=4, laps=1)
    for name, walk in (("a", short), ("b", short), ("c", replace(short, seed=8))):
        list(write_walk(tmp_path / name, walk))
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*"))
    same = [(tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes() for file in files]
    # rgb.txt and groundtruth.txt say the sequence's own name in a comment.
    assert {file.name for file, equal in zip(files, same, strict=True) if not equal} == {"rgb.txt", "groundtruth.txt"}
    assert (tmp_path / "a/rgb/1000.000000.jpg").read_bytes() != (tmp_path / "c/rgb/1000.000000.jpg").read_bytes()


def test_depth_has_tums_format_and_the_distances_of_walls(tmp_path: Path) -> None:
    """A pixel of one frame, taken to where its depth says, is the same surface in the next frame."""
    walk = replace(SMALL, frames=100, laps=1, depth=True)
    list(write_walk(tmp_path / "w", walk))
    sequence = read_sequence(tmp_path / "w")
    assert sequence.depths is not None
    assert sequence.poses is not None
    assert sequence.camera is not None
    first, second = (read_depth(path) for path in sequence.depths[:2] if path)
    assert 0 < first.min() < first.max() < 13.2
    rows, columns = (part.ravel() for part in np.mgrid[4 : SMALL.height : 4, 4 : SMALL.width : 4])
    rays = np.column_stack([sequence.camera.rays(np.column_stack([columns, rows])), np.ones(len(rows))])
    turns = Rotation.from_quat(sequence.poses[:2, 3:])
    world = turns[0].apply(rays * first[rows, columns, None]) + sequence.poses[0, :3]
    seen = turns[1].inv().apply(world - sequence.poses[1, :3])
    at = np.rint(seen[:, :2] / seen[:, 2:] * sequence.camera.fx + [sequence.camera.cx, sequence.camera.cy]).astype(int)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < SMALL.width) & (at[:, 1] < SMALL.height) & (seen[:, 2] > 0)
    there = second[at[inside, 1], at[inside, 0]]
    assert inside.sum() > 50
    assert np.mean(np.abs(there - seen[inside, 2]) < 0.1) > 0.75  # the others are hidden by something nearer


def test_every_lap_revisits_the_same_places(sequence: ImageSequence) -> None:
    truth = same_place_matrix(sequence.known_poses(), sequence.known_poses())
    lap = np.arange(SMALL.frames) * SMALL.laps // SMALL.frames
    for later in (1, 2):
        again = truth[np.ix_(lap == later, lap == 0)].any(axis=1)
        assert again.mean() > 0.9


def test_images_of_the_same_place_are_similar(folder: Path, sequence: ImageSequence) -> None:
    thumbnails = []
    for path in sequence.paths:
        picture = cv2.imread(str(path))
        assert picture is not None
        small = cv2.resize(picture, (16, 12), interpolation=cv2.INTER_AREA).astype(float).ravel()
        thumbnails.append((small - small.mean()) / small.std())
    alike = np.array(thumbnails) @ np.array(thumbnails).T / len(thumbnails[0])
    assert sequence.stamps is not None
    apart = np.abs(sequence.stamps[:, None] - sequence.stamps) > 10
    poses = sequence.known_poses()
    truth = same_place_matrix(poses, poses)
    nearly_the_same_view = same_place_matrix(poses, poses, 0.5, 6) & apart
    other = np.median(alike[~truth])
    assert np.median(alike[nearly_the_same_view]) > 0.6
    assert np.median(alike[truth & apart]) > other + 0.3
    assert other < 0.2


def test_laps_differ_in_light_and_position(sequence: ImageSequence) -> None:
    poses = sequence.known_poses()
    truth = same_place_matrix(poses, poses)
    later = np.flatnonzero(np.arange(SMALL.frames) >= SMALL.frames // SMALL.laps)
    aside = []
    for index in later:
        first_lap = np.flatnonzero(truth[index, : SMALL.frames // SMALL.laps])
        if len(first_lap):
            aside.append(np.linalg.norm(poses.positions[first_lap] - poses.positions[index], axis=1).min())
    assert 0.03 < np.median(aside) < 0.6


@pytest.mark.parametrize("seed", range(6))
def test_corners_appear_at_their_projected_positions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    texture = np.zeros((256, 256, 3), np.uint8)
    texture[:128, :128] = texture[128:, 128:] = 255
    quad = facing_quad(3.0, 1.6, texture)
    corner = np.array([0.0, 0.0, 3.0])
    rotation = Rotation.from_euler("xyz", rng.uniform([-12, -15, -30], [12, 15, 30]), degrees=True).as_matrix()
    position = rng.uniform([-0.8, -0.5, -0.5], [0.8, 0.5, 0.8])
    expected = CAMERA.project((corner - position) @ rotation)
    assert (expected > 8).all()
    assert (expected < [CAMERA.width - 8, CAMERA.height - 8]).all()

    picture = Renderer(flat_house(quad), CAMERA, plain_light()).draw(position, rotation)
    gray = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    start = np.array([[expected + rng.uniform(-1.5, 1.5, 2)]], np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    found = cv2.cornerSubPix(gray, start, (6, 6), (-1, -1), criteria)[0, 0]
    np.testing.assert_allclose(found, expected, atol=0.25)


def test_texture_columns_run_to_the_right_and_rows_down() -> None:
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32, :32], texture[:32, 32:], texture[32:, :32] = (250, 0, 0), (0, 250, 0), (0, 0, 250)
    picture = Renderer(flat_house(facing_quad(2.0, 1.2, texture)), CAMERA, plain_light()).draw(np.zeros(3), np.eye(3))
    assert picture[45, 65].tolist() == [250, 0, 0]
    assert picture[45, 95].tolist() == [0, 250, 0]
    assert picture[75, 65].tolist() == [0, 0, 250]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_nearer_surfaces_hide_others_in_any_order(order: tuple[int, int]) -> None:
    near = facing_quad(2.0, 0.5, np.full((32, 32, 3), 200, np.uint8))
    far = facing_quad(4.0, 8.0, np.full((32, 32, 3), 50, np.uint8))
    quads = [(near, far)[index] for index in order]
    picture = Renderer(flat_house(*quads), CAMERA, plain_light()).draw(np.zeros(3), np.eye(3))
    assert picture[60, 80, 0] == 200
    assert picture[10, 10, 0] == 50


def test_surfaces_are_invisible_from_behind() -> None:
    quad = facing_quad(2.0, 1.0, np.full((32, 32, 3), 200, np.uint8))
    turned = replace(quad, origin=quad.origin + quad.right, right=-quad.right)
    assert not Renderer(flat_house(turned), CAMERA, plain_light()).draw(np.zeros(3), np.eye(3)).any()


@pytest.mark.parametrize("seed", range(3))
def test_the_house_has_no_holes(seed: int) -> None:
    house = build_house(seed)
    white = [replace(quad, texture=np.full((32, 32, 3), 255, np.uint8)) for quad in house.quads]
    renderer = Renderer(House(white, house.rooms, house.way, house.step_m), CAMERA, plain_light(len(house.rooms)))
    for index in range(0, len(house.way), 40):
        position = np.append(house.way[index], 1.5)
        for turn in (0.0, 1.3, 2.9, 4.4):
            ahead = np.array([np.cos(turn), np.sin(turn), 0])
            right = np.array([np.sin(turn), -np.cos(turn), 0])
            picture = renderer.draw(position, np.column_stack([right, [0, 0, -1], ahead]))
            assert (picture == 255).mean() > 0.9995


@pytest.mark.parametrize("rooms", [4, 6, 8])
def test_the_path_visits_every_room_and_avoids_furniture(rooms: int) -> None:
    for seed in range(4):
        house = build_house(seed, rooms)
        for room in house.rooms:
            x0, y0, x1, y1 = room.bounds
            assert ((house.way > [x0, y0]) & (house.way < [x1, y1])).all(axis=1).any()
            assert len(room.footprints) >= 2
            for p0, o0, p1, o1 in room.footprints:
                gap = np.maximum(np.maximum([p0, o0] - house.way, house.way - [p1, o1]), 0)
                assert np.linalg.norm(gap, axis=1).min() >= 0.5


def test_the_camera_is_upright(sequence: ImageSequence) -> None:
    axes = Rotation.from_quat(sequence.known_poses().quaternions).as_matrix()
    assert (axes[:, 2, 1] < -0.98).all()  # y points down
    assert (np.abs(axes[:, 2, 0]) < 0.05).all()  # x is level
    assert (np.abs(sequence.known_poses().positions[:, 2] - 1.5) < 0.1).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rooms": 5}, "even number of rooms"),
        ({"frames": 1}, "frames must be 2"),
        ({"width": 8}, "width must be 32"),
        ({"laps": 0}, "laps must be 1"),
        ({"seed": -1}, "seed must be 0 or more"),
    ],
)
def test_invalid_settings_of_a_walk_are_refused(tmp_path: Path, change: dict[str, int], words: str) -> None:
    with pytest.raises(InputError, match=words):
        list(write_walk(tmp_path / "w", replace(SMALL, **change)))


def test_a_folder_with_a_sequence_is_not_overwritten(folder: Path) -> None:
    with pytest.raises(InputError, match="holds a sequence already"):
        list(write_walk(folder, SMALL))

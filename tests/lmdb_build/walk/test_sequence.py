"""The synthetic walk: true geometry, places really seen again, all from the seed."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lmdb_build.walk.house import House, Quad, Room, build_house
from lmdb_build.walk.render import Renderer
from lmdb_build.walk.sequence import Walk, write_walk
from loopclosure.errors import InputError
from loopclosure.places.frames import read_depth
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.intrinsics import Intrinsics
from loopclosure.places.same_place import same_place_matrix
from loopclosure.places.sequences import read_sequence

pytestmark = pytest.mark.slow

SMALL = Walk(frames=150, width=64, height=48, laps=3, seed=7)
CAMERA = Intrinsics(131.25, 131.25, 79.5, 59.5, size=(160, 120))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("walk") / "walk_1"
    assert len(list(write_walk(folder, SMALL))) == SMALL.frames
    return folder


@pytest.fixture(scope="module")
def sequence(folder: Path) -> ImageSequence:
    return read_sequence(folder, "tum").with_poses()


def drawn(house: House, position: np.ndarray | None = None, rotation: np.ndarray | None = None) -> np.ndarray:
    """What the camera sees, by default at the origin without rotation, in a light without direction."""
    light = np.ones((len(house.rooms), 3))
    pose = np.zeros(3) if position is None else position, np.eye(3) if rotation is None else rotation
    return Renderer(house, CAMERA, light).draw(*pose)[0]


def flat_house(*quads: Quad) -> House:
    room = Room(0, np.array([[-5.0, -5.0], [5.0, 5.0]]), np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    return House(list(quads), [room], np.zeros((1, 2)), 1.0)


def facing_quad(distance: float, size: float, texture: np.ndarray) -> Quad:
    """A square before a camera at the origin with no rotation (looking along +z, y down)."""
    origin = np.array([-size / 2, -size / 2, distance])
    return Quad(origin, np.array([size, 0, 0.0]), np.array([0, size, 0.0]), texture, 0)


def test_a_walk_has_tums_layout_and_a_pose_for_each_frame(sequence: ImageSequence) -> None:
    assert len(sequence) == SMALL.frames
    assert all(path.is_file() for path in sequence.paths)
    picture = cv2.imread(str(sequence.paths[0]))
    assert picture is not None
    assert picture.shape == (SMALL.height, SMALL.width, 3)


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


@pytest.mark.parametrize("seed", range(2))
def test_corners_appear_at_their_projected_positions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    texture = np.zeros((256, 256, 3), np.uint8)
    texture[:128, :128] = texture[128:, 128:] = 255
    quad = facing_quad(3.0, 1.6, texture)
    corner = np.array([0.0, 0.0, 3.0])
    rotation = Rotation.from_euler("xyz", rng.uniform([-12, -15, -30], [12, 15, 30]), degrees=True).as_matrix()
    position = rng.uniform([-0.8, -0.5, -0.5], [0.8, 0.5, 0.8])
    seen = (corner - position) @ rotation
    expected = seen[:2] / seen[2] * CAMERA.fx + [CAMERA.cx, CAMERA.cy]
    assert (expected > 8).all()
    assert (expected < [152, 112]).all()

    picture = drawn(flat_house(quad), position, rotation)
    gray = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    start = np.array([[expected + rng.uniform(-1.5, 1.5, 2)]], np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    found = cv2.cornerSubPix(gray, start, (6, 6), (-1, -1), criteria)[0, 0]
    np.testing.assert_allclose(found, expected, atol=0.25)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_nearer_surfaces_hide_others_in_any_order(order: tuple[int, int]) -> None:
    near = facing_quad(2.0, 0.5, np.full((32, 32, 3), 200, np.uint8))
    far = facing_quad(4.0, 8.0, np.full((32, 32, 3), 50, np.uint8))
    quads = [(near, far)[index] for index in order]
    picture = drawn(flat_house(*quads))
    assert picture[60, 80, 0] > 150
    assert 0 < picture[10, 10, 0] < 70


def test_the_house_has_no_holes() -> None:
    house = build_house(0)
    white = [replace(quad, texture=np.full((32, 32, 3), 255, np.uint8)) for quad in house.quads]
    renderer = Renderer(replace(house, quads=white), CAMERA, np.full((4, 3), 2.0))
    for index in range(0, len(house.way), 40):
        position = np.append(house.way[index], 1.5)
        for turn in (0.0, 1.3, 2.9, 4.4):
            ahead = np.array([np.cos(turn), np.sin(turn), 0])
            right = np.array([np.sin(turn), -np.cos(turn), 0])
            picture, _ = renderer.draw(position, np.column_stack([right, [0, 0, -1], ahead]))
            assert (picture == 255).mean() > 0.9995


@pytest.mark.parametrize("rooms", [4, 8])
def test_the_path_visits_every_room_and_avoids_boxes(rooms: int) -> None:
    for seed in range(2):
        house = build_house(seed, rooms)
        for room in house.rooms:
            assert ((house.way > room.corners[0]) & (house.way < room.corners[1])).all(axis=1).any()
        tops = [quad for quad in house.quads if 0 < quad.origin[2] < 1.2 and quad.down[2] == 0]
        assert len(tops) > rooms
        for top in tops:
            ends = np.array([top.origin, top.origin + top.right + top.down])[:, :2]
            gap = np.maximum(np.maximum(ends.min(axis=0) - house.way, house.way - ends.max(axis=0)), 0)
            assert np.linalg.norm(gap, axis=1).min() >= 0.5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rooms": 5}, "even number of rooms"),
        ({"frames": 1}, "frames must be 2"),
        ({"width": 8}, "width must be 32"),
        ({"laps": 0}, "laps must be 1"),
    ],
)
def test_invalid_settings_of_a_walk_are_refused(tmp_path: Path, change: dict[str, int], words: str) -> None:
    with pytest.raises(InputError, match=words):
        list(write_walk(tmp_path / "w", replace(SMALL, **change)))

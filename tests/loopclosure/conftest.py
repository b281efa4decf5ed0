"""A synthetic round trip for the tests of evaluation, report and detector."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

PLACES = 20


def blots(seed: int, height: int = 48, width: int = 64) -> np.ndarray:
    """A picture that differs from that of any other seed."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width, 3), 128, np.uint8)
    for _ in range(40):
        center = rng.integers(0, (width, height))
        color = [int(c) for c in rng.integers(0, 256, 3)]
        cv2.circle(image, (int(center[0]), int(center[1])), int(rng.integers(2, 9)), color, -1)
    return image


@pytest.fixture(scope="session")
def two_laps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rounds on a circle of 20 places, one a second, in TUM RGB-D layout; the second is a little darker.

    Neighboring places are 18 degrees apart, so that only frames i and i + 20 show the same place.
    """
    folder = tmp_path_factory.mktemp("data") / "two_laps"
    (folder / "rgb").mkdir(parents=True)
    names, poses = [], []
    for frame in range(2 * PLACES):
        image = blots(frame % PLACES)
        if frame >= PLACES:
            image = (image * 0.8).astype(np.uint8)
        cv2.imwrite(str(folder / "rgb" / f"{frame}.png"), image)
        names.append(f"{frame}.0 rgb/{frame}.png")
        turn = 2 * np.pi * frame / PLACES
        x, y, z, w = Rotation.from_euler("z", turn).as_quat()
        poses.append(f"{frame}.0 {5 * np.cos(turn):.4f} {5 * np.sin(turn):.4f} 1.0 {x:.6f} {y:.6f} {z:.6f} {w:.6f}")
    (folder / "rgb.txt").write_text("# synthetic\n" + "\n".join(names) + "\n")
    (folder / "groundtruth.txt").write_text("# synthetic\n" + "\n".join(poses) + "\n")
    return folder


@pytest.fixture(scope="session")
def two_laps_features(two_laps: Path) -> Path:
    """The features.npz of a perfect net: one direction a place, a little noise."""
    rng = np.random.default_rng(0)
    place = np.eye(PLACES)[np.arange(2 * PLACES) % PLACES]
    path = two_laps.parent / "perfect.npz"
    np.savez(
        path,
        features=(place + 0.01 * rng.normal(size=place.shape)).astype(np.float32),
        names=np.array([f"rgb/{i}.png" for i in range(2 * PLACES)]),
        stamps=np.arange(2 * PLACES, dtype=float),
        seconds_per_image=np.array(0.004),
    )
    return path

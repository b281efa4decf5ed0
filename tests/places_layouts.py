"""Small synthetic sequences in the layouts that people have: one path of a camera, written in each of them."""

import json
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

COUNT = 48
SIZE = (32, 24)
# The camera looks along +z, the body goes along +x: as on a car or a robot.
MOUNT = np.array([[0, 0, 1, 0.3], [-1, 0, 0, 0.1], [0, -1, 0, 0.2], [0, 0, 0, 1.0]])


def path() -> np.ndarray:
    """Poses (48, 4, 4) of a camera that drives two rounds on an ellipse, far from the origin, one a second."""
    turn = np.linspace(0, 4 * np.pi, COUNT, endpoint=False)
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, :3, 3] = np.stack([30 + 10 * np.cos(turn), 5 + 7 * np.sin(turn), 0.1 * np.sin(3 * turn)], axis=1)
    heading = np.arctan2(7 * np.cos(turn), -10 * np.sin(turn))
    poses[:, :3, :3] = Rotation.from_euler("z", heading[:, None]).as_matrix() @ MOUNT[:3, :3]
    return poses


def quaternions(poses: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)


def picture(number: int) -> np.ndarray:
    image = np.full((SIZE[1], SIZE[0], 3), (40, 90, 140), np.uint8)
    image[:, number % (COUNT // 2)] = 250
    return image


def write_pictures(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True)
    for number, name in enumerate(names):
        assert cv2.imwrite(str(folder / name), picture(number))


def tum_rows(poses: np.ndarray, start_s: int = 0) -> str:
    rows = zip(poses[:, :3, 3], quaternions(poses), strict=True)
    return "".join(f"{start_s + i}.0 " + " ".join(f"{v:.6f}" for v in (*p, *q)) + "\n" for i, (p, q) in enumerate(rows))


def kitti_rows(poses: np.ndarray) -> str:
    return "".join(" ".join(f"{value:.6e}" for value in pose[:3].ravel()) + "\n" for pose in poses)


def euroc_rows(poses: np.ndarray, per_second: int = 1) -> str:
    rows = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"]
    for i, (pose, (x, y, z, w)) in enumerate(zip(poses, quaternions(poses), strict=True)):
        values = (*pose[:3, 3], w, x, y, z, 0, 0, 0)
        rows.append(f"{1403636579 * 10**9 + i * 10**9 // per_second}," + ",".join(f"{v:.6f}" for v in values))
    return "\r\n".join(rows) + "\r\n"


def write_tum(folder: Path) -> Path:
    names = [f"{i:06d}.png" for i in range(COUNT)]
    write_pictures(folder / "tum" / "rgb", names)
    (folder / "tum" / "rgb.txt").write_text("".join(f"{i}.0 rgb/{name}\n" for i, name in enumerate(names)))
    (folder / "tum" / "groundtruth.txt").write_text(tum_rows(path()))
    return folder / "tum"


def write_euroc(folder: Path) -> Path:
    base = folder / "MH_00" / "mav0"
    stamps = [1403636579 * 10**9 + i * 10**9 for i in range(COUNT)]
    write_pictures(base / "cam0" / "data", [f"{stamp}.png" for stamp in stamps])
    listing = "".join(f"{stamp},{stamp}.png\r\n" for stamp in stamps)
    (base / "cam0" / "data.csv").write_text("#timestamp [ns],filename\r\n" + listing)
    rows = ",\n         ".join(", ".join(f"{value:g}" for value in row) for row in MOUNT)
    (base / "cam0" / "sensor.yaml").write_text(
        f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{rows}]\nrate_hz: 20\nresolution: [32, 24]\n"
        "camera_model: pinhole\nintrinsics: [28.5, 28.25, 15.5, 11.5] #fu, fv, cu, cv\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]\n"
    )
    (base / "state_groundtruth_estimate0").mkdir()
    body = path() @ np.linalg.inv(MOUNT)
    (base / "state_groundtruth_estimate0" / "data.csv").write_text(euroc_rows(body))
    return folder / "MH_00"


def write_kitti(folder: Path, camera: str = "image_0") -> Path:
    """A KITTI sequence 07; P2 is 6 cm to the left of camera 0."""
    sequence = folder / "dataset" / "sequences" / "07"
    write_pictures(sequence / camera, [f"{i:06d}.png" for i in range(COUNT)])
    (sequence / "times.txt").write_text("".join(f"{i:.6e}\n" for i in range(COUNT)))
    (sequence / "calib.txt").write_text(
        "".join(f"P{k}: 30 0 15.5 {tx:g} 0 30 11.5 0 0 0 1 0\n" for k, tx in enumerate((0, -16, 1.8, -15)))
    )
    (folder / "dataset" / "poses").mkdir()
    (folder / "dataset" / "poses" / "07.txt").write_text(kitti_rows(path()))
    return sequence


def write_benchmark(folder: Path, queries: int = 12, references: int = 14) -> Path:
    """A folder as VPR-Bench ships it: query i shows reference i + 1, and its neighbors."""
    write_pictures(folder / "query", [f"{i:07d}.jpg" for i in range(queries)])
    write_pictures(folder / "ref", [f"{i:07d}.jpg" for i in range(references)])
    (folder / "ground_truth.json").write_text(json.dumps([[i, [i, i + 1, i + 2]] for i in range(queries)]))
    return folder


def write_video(file: Path) -> Path:
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 1.0, SIZE)
    for number in range(COUNT):
        writer.write(picture(number))
    writer.release()
    return file

"""examples/ros_node.py with a real master: images and odometry in, loops and a better path out."""

import os
import shutil
import socket
import subprocess
import sys
import time
import xmlrpc.client
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from lmdb_build.cli import main as lmdb_build
from loopclosure.closing.close import ate_rmse_m, drifted
from loopclosure.places.sequences import read_sequence
from paths import ROOT

DEBIAN = Path("/usr/lib/python3/dist-packages")  # of python3-rospy and its messages
MASTER = shutil.which("rosmaster")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        MASTER is None or not (DEBIAN / "rospy").is_dir() or not (DEBIAN / "nav_msgs").is_dir(),
        reason="not installed: python3-rosmaster, python3-rospy, python3-sensor-msgs, python3-nav-msgs",
    ),
]
# Debian's packages come after those of this environment, which has a newer numpy.
START = f"import sys, runpy; sys.path.append({str(DEBIAN)!r}); sys.argv[:] = sys.argv[1:]; "
START += "runpy.run_path(sys.argv[0], run_name='__main__')"


@pytest.fixture
def master(tmp_path: Path) -> Iterator[dict[str, str]]:
    """The environment of programs that talk to a master of their own."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    uri = f"http://127.0.0.1:{port}"
    environment = {"ROS_MASTER_URI": uri, "ROS_HOSTNAME": "127.0.0.1", "ROS_LOG_DIR": str(tmp_path / "log")}
    environment |= {**os.environ, **environment, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    assert MASTER is not None
    plain = {key: value for key, value in environment.items() if key != "PYTHONPATH"}
    running = subprocess.Popen([MASTER, "--core", "-p", str(port)], env=plain, stdout=subprocess.DEVNULL)
    try:
        for _ in range(200):
            try:
                xmlrpc.client.ServerProxy(uri).getPid("/test")
                break
            except OSError:
                time.sleep(0.1)
        yield environment
    finally:
        running.terminate()
        running.wait(20)


def test_the_node_closes_loops_and_corrects_the_path(master: dict[str, str], tmp_path: Path) -> None:
    assert lmdb_build(["walk", str(tmp_path / "walk"), "--frames", "64", "--laps", "2", "--size", "160x120"]) == 0
    sequence = read_sequence(tmp_path / "walk" / "walk_1")
    assert sequence.poses is not None
    assert sequence.camera is not None
    odometry = drifted(sequence.poses, 3.0, 1)
    np.save(tmp_path / "odometry.npy", odometry)
    camera = sequence.camera
    node = subprocess.Popen(
        [
            *(sys.executable, "-c", START, str(ROOT / "examples" / "ros_node.py")),
            f"_camera:={camera.fx},{camera.fy},{camera.cx},{camera.cy}",
            "_mount:=0,0,0,0,0,0,1",  # the odometry is the camera's
            "_describe:=loopclosure.descriptors.thumbnails:Thumbnailer",
        ],
        env=master,
    )
    try:
        words = [str(tmp_path / "walk" / "walk_1"), str(tmp_path / "odometry.npy"), str(tmp_path / "heard.npz")]
        drive = str(ROOT / "tests" / "ros_drive.py")
        subprocess.run([sys.executable, "-c", START, drive, *words], env=master, check=True, timeout=500)
        assert node.poll() is None
    finally:
        node.terminate()
        node.wait(30)
    with np.load(tmp_path / "heard.npz") as heard:
        loops, path, frames = heard["loops"], heard["path"], (2 * (heard["stamps"] - 1000)).round().astype(int)
        variances = heard["variances"]
    assert len(loops) >= 3
    assert np.all(variances > 0)
    before, after = (ate_rmse_m(poses, sequence.poses[frames]) for poses in (odometry[frames], path))
    print(f"{len(loops)} loops, {len(path)} poses: {before:.3f} m before, {after:.3f} m after")
    assert after < 0.7 * before

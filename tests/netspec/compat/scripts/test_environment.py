"""The switch that puts a package ``caffe`` and Caffe's commands into an environment, in one made for the test."""

import subprocess
import sysconfig
import venv
from pathlib import Path

import numpy as np
import pytest

from paths import ROOT

pytestmark = pytest.mark.slow

COMMANDS = (
    "caffe",
    "convert_imageset",
    "compute_image_mean",
    "extract_features",
    "upgrade_net_proto_text",
    "upgrade_net_proto_binary",
    "upgrade_solver_proto_text",
)


@pytest.fixture
def environment(tmp_path: Path) -> Path:
    """An environment that finds this project, and what it depends on where this Python does."""
    folder = tmp_path / "venv"
    venv.create(folder, symlinks=True)
    (site,) = folder.glob("lib/python*/site-packages")
    paths = {str(ROOT), sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (site / "dependencies.pth").write_text("\n".join(paths))
    return folder


def run(environment: Path, *words: str, rc: int = 0) -> subprocess.CompletedProcess[str]:
    command, *rest = words
    done = subprocess.run(
        [str(environment / "bin" / command), *rest], cwd=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == rc, done.stderr
    return done


def files(environment: Path) -> set[Path]:
    return {path for path in environment.rglob("*") if path.is_file() and "__pycache__" not in path.parts}


IMPORT = "import caffe, caffe.io; from caffe.proto import caffe_pb2; print(caffe.__name__, caffe_pb2.TEST)"


def test_caffe_is_installed_and_removed(environment: Path) -> None:
    before = files(environment)
    run(environment, "python", "-c", IMPORT, rc=1)
    said = run(environment, "python", "-m", "netspec", "install-caffe").stdout.splitlines()
    assert {Path(line.removesuffix(": written")) for line in said[:-1]} == files(environment) - before
    assert said[-1] == "import caffe and Caffe's commands now use netspec; netspec remove-caffe undoes this"
    assert run(environment, "python", "-c", IMPORT).stdout == "netspec.compat.pycaffe 1\n"
    for name in COMMANDS:
        assert "usage" in run(environment, name, "--help").stdout
    run(environment, "python", "-m", "netspec", "install-caffe")  # again: the same
    (environment / "s.py").write_text(IMPORT)
    ran = run(environment, "python", "-m", "netspec", "run", "s.py")
    assert (ran.stdout, "installed" in ran.stderr) == ("netspec.compat.pycaffe 1\n", False)  # it is no other Caffe
    (environment / "s.py").unlink()
    removed = run(environment, "python", "-m", "netspec", "remove-caffe").stdout.splitlines()
    assert removed == [line.replace(": written", ": removed") for line in said[:-1]]
    assert files(environment) == before
    again = run(environment, "python", "-m", "netspec", "remove-caffe").stdout
    assert again == "nothing to remove: install-caffe wrote nothing into this Python environment\n"
    run(environment, "python", "-c", IMPORT, rc=1)


def test_caffes_command_trains(environment: Path) -> None:
    run(environment, "python", "-m", "netspec", "install-caffe")
    data = 'layer { name: "x" type: "DummyData" top: "x" top: "y" dummy_data_param { shape { dim: 2 dim: 3 } } }'
    ip = 'layer { name: "ip" type: "InnerProduct" bottom: "x" top: "ip" inner_product_param { num_output: 3 } }'
    loss = 'layer { name: "l" type: "EuclideanLoss" bottom: "ip" bottom: "y" top: "l" }'
    (environment / "net.prototxt").write_text(f"{data}\n{ip}\n{loss}\n")
    (environment / "solver.prototxt").write_text(
        'net: "net.prototxt" base_lr: 0.1 lr_policy: "fixed" max_iter: 2 snapshot_prefix: "s" solver_mode: CPU\n'
    )
    assert "Optimization Done." in run(environment, "caffe", "train", "-solver=solver.prototxt").stderr
    assert (environment / "s_iter_2.caffemodel").is_file()
    run(environment, "upgrade_net_proto_text", "net.prototxt", "new.prototxt")


def test_existing_files_are_refused(environment: Path) -> None:
    (site,) = environment.glob("lib/python*/site-packages")
    (site / "caffe").mkdir()
    (site / "caffe" / "__init__.py").write_text("real = 1")
    (environment / "bin" / "caffe").write_text("#!/bin/sh\necho real\n")
    before = files(environment)
    refused = run(environment, "python", "-m", "netspec", "install-caffe", rc=1).stderr
    assert refused.count("\n") == 1
    assert f"{site / 'caffe' / '__init__.py'}, {environment / 'bin' / 'caffe'}: already exists" in refused
    assert files(environment) == before


def test_a_real_caffe_elsewhere_on_the_path_is_refused(environment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (environment / "caffe.py").write_text("real = 1")
    monkeypatch.setenv("PYTHONPATH", str(environment))
    assert "caffe.py: already exists" in run(environment, "python", "-m", "netspec", "install-caffe", rc=1).stderr


CREATE = (Path(__file__).parent / "programs" / "create.sh").read_text()


def test_shell_scripts_find_the_commands_where_caffe_is_built(environment: Path) -> None:
    import cv2

    mnist = environment / "examples" / "mnist"
    data = environment / "data" / "mnist"
    mnist.mkdir(parents=True)
    data.mkdir(parents=True)
    head = b"\0\0\x08"
    (data / "train-images-idx3-ubyte").write_bytes(head + b"\3\0\0\0\2\0\0\0\4\0\0\0\4" + bytes(range(32)))
    (data / "train-labels-idx1-ubyte").write_bytes(head + b"\1\0\0\0\2\0\1")
    cv2.imwrite(str(data / "a.png"), np.zeros((8, 8), np.uint8))
    (data / "list.txt").write_text("a.png 1\n")
    transform = 'transform_param { mean_file: "examples/mnist/mean.binaryproto" scale: 0.01 }'
    source = 'data_param { source: "examples/mnist/mnist_train_lmdb" batch_size: 2 backend: LMDB }'
    ip = 'layer { name: "ip" type: "InnerProduct" bottom: "data" top: "ip" inner_product_param { num_output: 2 } }'
    loss = 'layer { name: "loss" type: "SoftmaxWithLoss" bottom: "ip" bottom: "label" top: "loss" }'
    layer = f'layer {{ name: "d" type: "Data" top: "data" top: "label" {transform} {source} }}'
    (mnist / "net.prototxt").write_text(f"{layer}\n{ip}\n{loss}\n")
    (mnist / "lenet_solver.prototxt").write_text(
        'net: "examples/mnist/net.prototxt" base_lr: 0.1 lr_policy: "fixed" max_iter: 2 solver_mode: CPU\n'
        'snapshot_prefix: "examples/mnist/lenet"\n'
    )
    (environment / "create.sh").write_text(CREATE)
    (environment / "create.sh").chmod(0o755)
    before = files(environment)
    said = run(environment, "python", "-m", "netspec", "install-caffe", "--build", "build").stdout.splitlines()
    assert {environment / line.removesuffix(": written") for line in said[:-1]} == files(environment) - before
    run(environment, "python", "-c", IMPORT, rc=1)  # the environment stays as it was
    done = run(environment, "../create.sh")
    assert "Loss: " in done.stderr
    assert (mnist / "images_lmdb" / "data.mdb").is_file()
    (environment / "build" / "mine").write_text("mine")
    run(environment, "python", "-m", "netspec", "remove-caffe", "--build", "build")
    assert {path.name for path in (environment / "build").rglob("*")} == {"mine"}


def test_a_real_build_is_not_changed(environment: Path) -> None:
    tool = environment / "build" / "tools" / "caffe"
    tool.parent.mkdir(parents=True)
    tool.write_text("#!/bin/sh\necho real\n")
    refused = run(environment, "python", "-m", "netspec", "install-caffe", "--build", "build", rc=1).stderr
    assert "build/tools/caffe: already exists and is not netspec's; choose another folder" in refused
    run(environment, "python", "-m", "netspec", "remove-caffe", "--build", "build")
    assert [path for path in (environment / "build").rglob("*") if path.is_file()] == [tool]

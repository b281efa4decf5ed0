"""Every command and every Python snippet of the pages runs, in a folder that has what the page supposes to be there.

What is not in ``NOT_RUN`` is run. tests/laws/test_documents.py parses all of them.
"""

import shlex
import shutil
from importlib.util import find_spec
from pathlib import Path

import pytest

import playground
from documents import DOCUMENTS, PROGRAMS, Command, blocks, commands, run, run_snippet

EXTRAS = ("onnx", "onnxruntime", "openvino", "pygls", "rosbags", "shtab", "tensorboard")
MISSING = [name for name in EXTRAS if find_spec(name) is None]
pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}")]

# What each page supposes to be there, of the files that playground.py makes.
SUPPOSED = {
    "README.md": "deploy.prototxt x.caffemodel solver.prototxt train_val.prototxt train_lmdb",
    "loopclosure/README.md": "prototxt FOLDER SEQUENCE OTHER_IMAGES others.npz odometry.txt corridor_loop "
    "train.txt rgbd_dataset_freiburg1_xyz",
    "netspec/README.md": "train_val.prototxt deploy.prototxt solver.prototxt a.prototxt b.prototxt x.caffemodel "
    "train_lmdb FOLDER train.log old_caffe.log script.py",
    "prototxt/README.md": "prototxt tum src FOLDER",
    "docs/closing.md": "prototxt drive.bag wheels.txt",
    "docs/coming-from-opencv.md": "deploy.prototxt face.caffemodel",
    "docs/datasets.md": "MH_01_easy dataset drive.bag drive.mp4 slam.txt Nordland",
    "docs/gallery.md": "prototxt data train.log a.png b.png FOLDER",
    "docs/how-to.md": "deploy.prototxt solver.prototxt train_val.prototxt x.caffemodel train_lmdb FOLDER prototxt tum",
    "docs/index.md": "deploy.prototxt solver.prototxt train_val.prototxt x.caffemodel train_lmdb SEQUENCE",
    "docs/engines.md": "net.prototxt net.caffemodel deploy.prototxt train_lmdb photos",
    "docs/inference.md": "prototxt deploy.prototxt net.caffemodel",
    "docs/methods.md": "SEQUENCE net.pt2 A B",
    "docs/nets.md": "prototxt a.caffemodel b.caffemodel",
    "docs/paper.md": "prototxt",
    "docs/results.md": "prototxt rgbd_dataset_freiburg1_xyz",
    "docs/robot.md": "drive.mp4",
    "docs/seeing.md": "train.log old_caffe.log solver.prototxt train_val.prototxt train_lmdb deploy.prototxt "
    "x.caffemodel a.png b.png FOLDER",
    "docs/training.md": "solver.prototxt train_val.prototxt train_lmdb train.log",
}
# The names that snippets use and do not define.
GIVEN = "import numpy, torch; images, image = torch.rand(2, 3, 32, 32), numpy.zeros((32, 32, 3), numpy.uint8)\n"
# What stands in a page, and what runs in its place: the same on less.
LESS = {
    "README.md": {"--frames 400": "--frames 60"},
    "netspec/README.md": {"step(100)": "step(2)", "--iterations 50": "--iterations 2"},
    "prototxt/README.md": {
        "--train 30000 --val 6000 --test 6000": "--train 20 --val 8 --test 8",
        "--train 3000 --val 600": "--train 20 --val 8",
        "prototxt/small/siamese_8/solver.prototxt prototxt/small": "prototxt/small",
        "prototxt/small/siamese_resnet27_256/solver.prototxt prototxt/small/siamese_resnet27_512/solver.prototxt": "",
        "--train 22000 --val 800": "--train 20 --val 4",
        "--train 9000 --val 0 --test 1000": "--train 20 --val 0 --test 4",
        "--frames 250 --size 160x120": "--frames 30 --size 64x48",
        "--train 6000 --val 600": "--train 20 --val 4",
        "--batches 1000": "--batches 1",
        "--batches 500": "--batches 1",
        "siamese_words_256_iter_4000": "siamese_words_256_iter_2",
    },
    "docs/closing.md": {"--frames 250": "--frames 60"},
    "docs/datasets.md": {
        "--min-gap 10 --out": "--min-gap 10 --train 8 --val 0 --test 0 --out",
        "--train 2000 --val 400": "--train 4 --val 2",
    },
    "docs/how-to.md": {"--train 2000 --val 400": "--train 8 --val 4"},
    "docs/growth.md": {
        "pairs 1000 10000 100000 1000000": "pairs 10 20",
        "frames 1000 10000 100000 1000000": "frames 10 20",
        "places 1000 3000 10000": "places 10 20",
    },
    "docs/paper.md": {"--frames 250": "--frames 60", "--train 1600 --val 400": "--train 96 --val 50"},
    "docs/seeing.md": {"--start 1000": "--start 10"},
}
BENCH = "tests/benchmarks/test_bench.py runs it on less"
LOOPS = "needs public sequences, and hours; tests/benchmarks/test_loops.py runs its parts"
# How a command begins that does not run here, and why.
NOT_RUN = {
    "README.md": {
        "tools/quickstart": "minutes; the commands of docs/paper.md",
        "tools/run_tests": "runs this test",
    },
    "benchmarks/README.md": {
        "tools/bench forward": "installs OpenCV 4; " + BENCH,
        "tools/bench train small/siamese_8": BENCH,
        "tools/bench train lenet": "needs Caffe",
        "tools/bench small": "needs Caffe",
        "tools/bench start": BENCH,
        "tools/bench waiting": "a minute of two trainings side by side",
        "tools/bench feeding": BENCH,
        "tools/bench growth": BENCH,
        "tools/bench settings": LOOPS,
        "tools/bench tables": LOOPS,
        "benchmarks/gpu_steps": "needs a GPU; tests/benchmarks/test_gpu_steps.py runs it without one",
    },
    "prototxt/README.md": {
        "lmdb-build compare prototxt/normalized/siamese_8": "needs a GPU",
        "python3 examples/validation_set.py": "tests/test_examples.py runs it",
        "loopclosure evaluate traverses:val/outdoor": "needs what that script writes",
    },
    "docs/faithful.md": {"tools/run_tests": "runs tests that run beside this one"},
    "docs/from-pytorch.md": {
        "pip install": "needs a package index",
        "python3 examples/efficientnet_lite0.py": "tests/test_examples.py runs it",
        "netspec check efficientnet_lite0": "needs what that script writes",
        "netspec fold efficientnet_lite0": "needs what that script writes",
        "netspec extract efficientnet_lite0": "needs what that script writes",
    },
    "docs/growth.md": {"tools/bench growth layers": BENCH, "tools/bench growth batch": BENCH},
    "docs/performance.md": {"tools/bench": "times are measured, for minutes; " + BENCH},
    "docs/results.md": {"tools/bench": LOOPS},
    "docs/start.md": {
        "python3 -m venv": "tests/test_wheel.py makes an environment",
        "pip install": "needs a package index; tests/test_wheel.py installs the wheel",
    },
    "docs/training.md": {
        "netspec train --solver solver.prototxt --compile": "compiles for long; tests/netspec/net/test_segments.py",
        "netspec train --solver solver.prototxt --gpu": "needs a GPU; tests/netspec/test_gpu.py has a fake one",
        "torchrun --nnodes 8": "needs eight machines",
    },
}
FOUND: dict[tuple[str, ...], int] = {("netspec", "diff"): 1}  # says by its status that files differ

PAGES = [page for page in DOCUMENTS if any(block.language in ("", "python") for block in blocks(page))]


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return playground.make(tmp_path_factory.mktemp("pages") / "made")


@pytest.fixture
def folder(request: pytest.FixtureRequest, made: Path, tmp_path: Path) -> Path:
    """A copy of what a page supposes to be there."""
    copy = tmp_path / "folder"
    copy.mkdir()
    for name in SUPPOSED.get(request.getfixturevalue("page"), "").split():
        source = made / name
        if source.is_symlink():
            (copy / name).symlink_to(source.readlink())
        elif source.is_dir():
            shutil.copytree(source, copy / name, symlinks=True)
        else:
            shutil.copy(source, copy / name)
    return copy


@pytest.mark.parametrize("page", PAGES)
def test_a_page_runs_as_it_stands(page: str, folder: Path, tmp_path: Path) -> None:
    log, less, not_run = tmp_path / "log", dict(LESS.get(page, {})), dict(NOT_RUN.get(page, {}))

    def expect(status: int | None, what: str, expected: int = 0) -> None:
        assert status == expected, f"{what}\n{log.read_text()[-3000:]}"

    for block in blocks(page):
        text = block.text
        for old in [old for old in less if old in text]:
            text = text.replace(old, LESS[page][old])
            less[old] = ""
        if block.file and block.language:
            (folder / block.file).write_text(text)
        elif block.language == "python":
            expect(run_snippet(GIVEN + text, folder, log), block.where)
        elif not block.language:
            for command in commands(text, folder):
                line = shlex.join(command.words)
                for beginning in [beginning for beginning in NOT_RUN.get(page, ()) if line.startswith(beginning)]:
                    not_run[beginning] = ""
                    break
                else:
                    assert PROGRAMS[command.words[0]], f"{block.where}: {line}: neither run nor in NOT_RUN"
                    expect(run(command, log), f"{block.where}: {line}", FOUND.get(command.words[:2], 0))
    assert not [reason for reason in not_run.values() if reason], "NOT_RUN names commands that the page does not have"
    assert not [old for old, new in less.items() if new], "LESS names text that the page does not have"


def test_the_tables_name_pages() -> None:
    assert {*SUPPOSED, *LESS, *NOT_RUN} <= set(PAGES)


def test_a_command_and_a_snippet_that_fail_are_noticed(tmp_path: Path) -> None:
    log = tmp_path / "log"
    assert run(Command(("netspec", "chekc"), tmp_path), log) == 2
    assert "chekc" in log.read_text()
    assert run(Command(("netspec", "check", "no.prototxt"), tmp_path), log) == 1
    assert run_snippet("import netspec; netspec.load_net('no.prototxt')", tmp_path, log) == 1
    assert "no.prototxt" in log.read_text()

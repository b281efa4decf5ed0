"""Every command and every Python snippet of the pages runs unmodified, in a copy of what playground.py makes.

A block below ``<!-- not run: REASON -->`` is not run, nor are programs without a main() in ``PROGRAMS``: they install,
measure for minutes or start these tests, and have tests of their own. tests/laws/test_documents.py parses all of them.
"""

import fcntl
import os
import re
import shlex
import shutil
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import pytest
import torch

import playground
from documents import DOCUMENTS, PROGRAMS, Command, blocks, commands, run, run_snippet

EXTRAS = ("onnx", "onnxruntime", "openvino", "rosbags", "tensorboard")
MISSING = [name for name in EXTRAS if find_spec(name) is None]
pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}")]

# The names that snippets use and do not define.
GIVEN = "import numpy, torch; images, image = torch.rand(2, 3, 32, 32), numpy.zeros((32, 32, 3), numpy.uint8)\n"
# The most of each that a test has time or data for.
MOST = {"--frames": 60, "--train": 24, "--val": 8, "--test": 4, "--batches": 1, "--start": 10}
# Where the CPU has none, a training in bf16 takes five times as long as in fp32.
BF16 = torch.ops.mkldnn._is_mkldnn_bf16_supported()
# A GPU, other machines; tests/netspec has test_gpu and solver/test_processes.
NEEDS = {"--gpu", "--nnodes"}
FOUND: dict[tuple[str, ...], int] = {("netspec", "diff"): 1}  # says by its status that files differ

PAGES = [page for page in DOCUMENTS if any(block.language in ("", "python") for block in blocks(page))]


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder, which all processes of a parallel run share: the first one makes it."""
    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "made"
    with folder.with_suffix(".lock").open("a+") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.with_suffix(".done").exists():
            shutil.rmtree(folder, ignore_errors=True)
            playground.make(folder)
            folder.with_suffix(".done").touch()
    return folder


def less(words: tuple[str, ...]) -> tuple[str, ...]:
    """Return a command with the numbers behind the options of ``MOST`` cut; all trainings take two iterations."""
    words = tuple(re.sub(r"_iter_\d+", "_iter_2", word) for word in words)
    if words[:2] == ("netspec", "train") and not BF16:
        words = tuple("fp32" if before == "--precision" else word for before, word in pairwise(("", *words)))
    most = MOST.copy()
    if "--sequences" in words:  # all of them together have 120
        most["--frames"] = 120 // max(2, int(words[words.index("--sequences") + 1]))
    pairs = zip(("", *words), words, strict=False)
    return tuple(str(min(most[b], int(word))) if b in most and word.isdigit() else word for b, word in pairs)


@pytest.mark.parametrize("page", PAGES)
def test_commands_of_a_page_run(page: str, made: Path, tmp_path: Path) -> None:
    folder, log = shutil.copytree(made, tmp_path / "folder", symlinks=True), tmp_path / "log"
    for block in blocks(page):
        if block.file and block.language:
            (folder / block.file).write_text(block.text)
        elif block.language == "python":
            assert run_snippet(GIVEN + block.text, folder, log) == 0, f"{block.where}\n{log.read_text()[-3000:]}"
        elif not block.language and not block.not_run:
            for command in commands(block.text, folder):
                if command.words[0] == "tools/quickstart":
                    playground.quickstart(folder)
                if PROGRAMS[command.words[0]] and not NEEDS & set(command.words):
                    status = run(Command(less(command.words), command.folder), log)
                    line = f"{block.where}: {shlex.join(command.words)}"
                    assert status == FOUND.get(command.words[:2], 0), f"{line}\n{log.read_text()[-3000:]}"


def test_failing_commands_and_snippets_are_noticed(tmp_path: Path) -> None:
    log = tmp_path / "log"
    assert run(Command(("netspec", "chekc"), tmp_path), log) == 2
    assert "chekc" in log.read_text()
    assert run(Command(("netspec", "check", "no.prototxt"), tmp_path), log) == 1
    assert run_snippet("import netspec; netspec.load_net('no.prototxt')", tmp_path, log) == 1
    assert "no.prototxt" in log.read_text()

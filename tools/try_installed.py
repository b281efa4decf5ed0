"""Try an installation: import every module, and run the commands of a training on the golden files in ``sys.argv[1]``.

It runs with the installation's own Python, away from the source. ``tools/build_release`` calls it.
"""

from __future__ import annotations

import importlib
import pkgutil
import platform
import re
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

EXTRAS = {
    "onnx",
    "onnxruntime",
    "openvino",
    "plyvel",
    "plyvel_next",
    "skimage",
    "tensorboard",
}
SCRIPTS = Path(sys.executable).parent


def modules(package: str) -> list[str]:
    """Return the modules of a package, except __main__, which would run, and dialects, which have duplicate names."""
    found = importlib.import_module(package)
    walked = pkgutil.walk_packages(found.__path__[:1], f"{package}.")
    return [module.name for module in walked if not re.search(r"__main__$|\.dialects\.", module.name)]


def run(*words: str, stderr: int = subprocess.PIPE) -> str:
    """Run a command of the installation; return what it printed on stdout."""
    command = [str(SCRIPTS / words[0]), *words[1:]]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=stderr, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(words)}: status {done.returncode}\n{done.stderr or done.stdout}")
    return done.stdout


def main(golden: Path) -> None:
    """Import, train, draw."""
    missing = set()
    count = 0
    for package in ("netspec", "loopclosure", "lmdb_build"):
        for name in modules(package):
            try:
                importlib.import_module(name)
                count += 1
            except ModuleNotFoundError as fault:
                if (fault.name or "").partition(".")[0] not in EXTRAS:
                    raise
                missing.add(fault.name)
    import netspec

    assert "site-packages" in netspec.__file__, netspec.__file__
    shutil.copytree(golden / "train" / "sgd_step", "sgd_step")
    shutil.copytree(golden / "pairs", "pairs")
    assert run("netspec", "--version") == f"netspec {version('netspec-caffe')}\n"
    run("netspec", "check", "--data", "sgd_step/solver.prototxt")
    log = run("netspec", "train", "--solver", "sgd_step/solver.prototxt", stderr=subprocess.STDOUT)
    Path("train.log").write_text(log, "utf-8")
    out = run("netspec", "plot", "train.log", "--out", "training.png")
    assert "state done, iterations 60" in out, out
    run("netspec", "data", "show", "pairs/test_lmdb", "--out", "sheet.png")
    run("lmdb-build", "walk", "walk", "--frames", "12", "--size", "48x36")
    run("loopclosure", "evaluate", "--help")
    from netspec.dialects.files import known_files

    for dialect in known_files():
        run("netspec", "layers", "--plugin", dialect)
    without = f", without {', '.join(sorted(map(str, missing)))}" if missing else ""
    print(f"Python {platform.python_version()}: {count} modules, and the commands of a training{without}")


main(Path(sys.argv[1]))

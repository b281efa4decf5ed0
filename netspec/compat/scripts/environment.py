"""Installs a ``caffe`` package and Caffe's commands into the current Python environment, and removes them again.

The package is a few lines that import netspec.pycaffe. The commands are those of netspec and lmdb_build under Caffe's
names. Shell scripts call commands in Caffe's build folder (``build/tools/caffe``), so such a folder can be made too.
Every written file begins with a mark, and no other file is ever removed.
"""

from __future__ import annotations

import shutil
import sys
import sysconfig
from contextlib import suppress
from pathlib import Path

from netspec.compat.scripts.finder import MARK, NAME, real_caffe
from netspec.errors import SpecError
from netspec.files.whole_file import write_whole

_PACKAGE = f'''{MARK}: written by `netspec install-caffe`, removed by `netspec remove-caffe`.
"""Caffe's Python interface, which netspec provides."""

import importlib
import sys

from netspec.compat.scripts import finder

finder.install()
sys.modules[__name__] = importlib.import_module(finder.HOME)
'''
_NETSPEC, _BUILD = "netspec.cli", "lmdb_build.cli"
_COMMANDS: dict[str, tuple[str, list[str]]] = {
    "caffe": (_NETSPEC, []),
    "convert_imageset": (_BUILD, ["imageset"]),
    "compute_image_mean": (_BUILD, ["mean"]),
    "extract_features": (_NETSPEC, ["extract_features"]),
    "upgrade_net_proto_text": (_NETSPEC, ["upgrade_net_proto_text"]),
    "upgrade_net_proto_binary": (_NETSPEC, ["upgrade_net_proto_binary"]),
    "upgrade_solver_proto_text": (_NETSPEC, ["upgrade_solver_proto_text"]),
}
_EXAMPLES: dict[str, tuple[str, list[str]]] = {  # in the build folder only
    "examples/mnist/convert_mnist_data": (_BUILD, ["mnist"]),
    "examples/siamese/convert_mnist_siamese_data": (_BUILD, ["mnist", "--pairs", "--backend=leveldb"]),
    "examples/cifar10/convert_cifar_data": (_BUILD, ["cifar"]),
}
_WINDOWS = sys.platform == "win32"
_ASIDE = ".before-netspec"  # suffix of files that are in the way, while ours are installed


def install_caffe(replace: bool = False) -> list[Path]:
    """Write the package and the commands; return the paths. Files that are in the way are renamed.

    Raises SpecError if a real Caffe or a command of one of these names exists, unless ``replace``, and OSError if the
    environment cannot be written to.
    """
    paths = {_package(): _PACKAGE} | {_script(name): _command(*command) for name, command in _COMMANDS.items()}
    in_the_way = [str(path) for path in paths if path.exists() and not _is_ours(path)]
    real = real_caffe()
    if real and real not in in_the_way:
        in_the_way.append(real)
    if in_the_way and not replace:
        there = ", ".join(in_the_way)
        raise SpecError(f"{there}: already exists and is not netspec's; use --replace to move it aside")
    for path, text in paths.items():
        owner = path.parent if path.name == "__init__.py" else path
        if owner.exists() and not _is_ours(path):
            owner.rename(owner.with_name(owner.name + _ASIDE))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text)
        if owner is path:
            path.chmod(0o755)
    return list(paths)


def remove_caffe() -> list[Path]:
    """Remove what :func:`install_caffe` wrote, and restore the files that it renamed; return the removed paths."""
    removed = []
    for path in (_package(), *map(_script, _COMMANDS)):
        owner = path.parent if path.name == "__init__.py" else path
        if not _is_ours(path):
            continue
        if owner is path:
            path.unlink()
        else:
            shutil.rmtree(owner)
        removed.append(path)
        aside = owner.with_name(owner.name + _ASIDE)
        if aside.exists():
            aside.rename(owner)
    return removed


def make_build_folder(folder: Path) -> list[Path]:
    """Write the commands at the paths of Caffe's build: ``tools/caffe``, ``tools/caffe.bin``, ...; return the paths.

    Raises SpecError if there is another file at one of these paths, and OSError if the folder cannot be written to.
    """
    paths = _build_paths(folder)
    there = [str(path) for path in paths if path.exists() and not _is_ours(path)]
    if there:
        raise SpecError(f"{', '.join(there)}: already exists and is not netspec's; choose another folder")
    for path, (module, words) in paths.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, _command(module, words))
        path.chmod(0o755)
    return list(paths)


def remove_build_folder(folder: Path) -> list[Path]:
    """Remove what :func:`make_build_folder` wrote, and folders that are then empty; return the removed paths."""
    removed = [path for path in _build_paths(folder) if _is_ours(path)]
    for path in removed:
        path.unlink()
    parents = {parent for path in removed for parent in path.parents if parent.is_relative_to(folder)}
    for parent in sorted(parents, reverse=True):  # the innermost first
        with suppress(OSError):  # it is not empty
            parent.rmdir()
    return removed


def _build_paths(folder: Path) -> dict[Path, tuple[str, list[str]]]:
    commands = {f"tools/{name}": command for name, command in _COMMANDS.items()} | _EXAMPLES
    return {folder / _file(f"{name}{end}"): command for name, command in commands.items() for end in ("", ".bin")}


def _package() -> Path:
    return Path(sysconfig.get_path("purelib")) / NAME / "__init__.py"


def _script(name: str) -> Path:
    return Path(sysconfig.get_path("scripts"), _file(name))


def _file(command: str) -> str:
    """Return the name of a command's file. Windows starts only files whose extension it knows."""
    return f"{command}.cmd" if _WINDOWS else command


def _command(module: str, words: list[str]) -> str:
    # On Windows the first line is a batch file that runs the other lines with Python, which skips the first (-x).
    first = f'@"{sys.executable}" -x "%~f0" %* & exit /b' if _WINDOWS else f"#!{sys.executable}"
    return f"""{first}
{MARK}: written by `netspec install-caffe`, removed by `netspec remove-caffe`.
import sys

from netspec.terminal.main import program

sys.exit(program({module!r}, [*{words}, *sys.argv[1:]]))
"""


def _is_ours(path: Path) -> bool:
    try:
        first = path.read_text("utf-8", errors="replace").splitlines()[:2]  # a command's first names Python
    except OSError:
        return False
    return any(line.startswith(MARK) for line in first)

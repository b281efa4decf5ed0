"""Installs a ``caffe`` package and Caffe's commands into the current Python environment, and removes them again.

The package is a few lines that import netspec.pycaffe. The commands are those of netspec and lmdb_build under Caffe's
names. Shell scripts call commands in Caffe's build folder (``build/tools/caffe``), so such a folder can be made too.
Every written file begins with a mark, and no other file is ever removed.
"""

from __future__ import annotations

import shutil
import sys
import sysconfig
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.machinery import PathFinder
from pathlib import Path

from netspec.compat.scripts.finder import NAME
from netspec.errors import SpecError
from netspec.files.whole_file import write_whole

_MARK = "# netspec as caffe: written by `netspec install-caffe`, removed by `netspec remove-caffe`."
_PACKAGE = f'''{_MARK}
"""Caffe's Python interface, which netspec provides."""

import sys

from netspec.compat.scripts import finder

finder.install()
sys.modules[__name__] = finder.package()
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


def install_caffe() -> list[Path]:
    """Write the package and the commands; return the paths.

    Raises SpecError if another Caffe or a command of one of these names exists, and OSError if the environment cannot
    be written to.
    """
    paths = {_package(): _PACKAGE} | {_script(name): _command(*command) for name, command in _COMMANDS.items()}
    found = PathFinder.find_spec(NAME)
    imported = [Path(found.origin)] if found is not None and found.origin else []  # a mere folder has no origin
    return _write(paths, "remove it first", imported)


def remove_caffe() -> list[Path]:
    """Remove what :func:`install_caffe` wrote; return the removed paths."""
    removed = [path for path in (_package(), *map(_script, _COMMANDS)) if _is_ours(path)]
    for path in removed:
        if path == _package():
            shutil.rmtree(path.parent)
        else:
            path.unlink()
    return removed


def make_build_folder(folder: Path) -> list[Path]:
    """Write the commands at the paths of Caffe's build: ``tools/caffe``, ``tools/caffe.bin``, ...; return the paths.

    Raises SpecError if there is another file at one of these paths, and OSError if the folder cannot be written to.
    """
    paths = {path: _command(*command) for path, command in _build_paths(folder).items()}
    return _write(paths, "choose another folder")


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


def _write(texts: Mapping[Path, str], advice: str, others: Sequence[Path] = ()) -> list[Path]:
    """Write the files if neither they nor ``others`` are there yet, unless they are ours; return their paths."""
    there = [str(path) for path in dict.fromkeys([*others, *texts]) if path.exists() and not _is_ours(path)]
    if there:
        raise SpecError(f"{', '.join(there)}: already exists and is not netspec's; {advice}")
    for path, text in texts.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text)
        if text.startswith("#!"):
            path.chmod(0o755)
    return list(texts)


def _build_paths(folder: Path) -> dict[Path, tuple[str, list[str]]]:
    commands = {f"tools/{name}": command for name, command in _COMMANDS.items()} | _EXAMPLES
    return {folder / f"{name}{end}": command for name, command in commands.items() for end in ("", ".bin")}


def _package() -> Path:
    return Path(sysconfig.get_path("purelib")) / NAME / "__init__.py"


def _script(name: str) -> Path:
    return Path(sysconfig.get_path("scripts"), name)


def _command(module: str, words: list[str]) -> str:
    return f"""#!{sys.executable}
{_MARK}
import sys

from netspec.terminal.main import program

sys.exit(program({module!r}, [*{words}, *sys.argv[1:]]))
"""


def _is_ours(path: Path) -> bool:
    try:
        first = path.read_text("utf-8", errors="replace").splitlines()[:2]  # a command's first names Python
    except OSError:
        return False
    return any(line.startswith(_MARK) for line in first)

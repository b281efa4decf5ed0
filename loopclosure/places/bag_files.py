"""Finds the files of a bag: of ROS 1 or ROS 2, whole or split, with or without metadata.yaml, by whatever name."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

from loopclosure.errors import InputError
from netspec.errors import SpecError
from netspec.files.image_list import list_images, natural_order

# The first bytes of a file, and the suffix by which the library rosbags knows it.
ROS_1, MCAP, SQLITE = b"#ROSBAG V", b"\x89MCAP0\r\n", b"SQLite format 3\0"
SUFFIXES = {ROS_1: ".bag", MCAP: ".mcap", SQLITE: ".db3"}
NAMES = re.compile(r".*\.(bag(\.active|\.orig)?|(mcap|db3)(\.active)?(\.zstd|\.zst)?)", re.IGNORECASE)
METADATA = "metadata.yaml"


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: a file of that form or name, or a folder of such files and no images."""
    if path.is_dir():
        return (path / METADATA).is_file() or bool(_files_in(path) and not _has_images(path))
    return bool(NAMES.fullmatch(path.name)) or _kind(path) in (".bag", ".mcap")


def bag_paths(path: Path, links: Path) -> list[Path]:
    """Return what to open: a folder with metadata, or one or several files of one recording.

    A file that does not have the suffix of its kind gets a link in the folder ``links`` that has it. Raises InputError
    if the path must be named otherwise.
    """
    if path.is_dir():
        if _has_metadata(path):
            return [path]
        files = _files_in(path)
    else:
        if path.suffix.lower() not in (".bag", ".mcap") and _has_metadata(path.parent):
            return [path.parent]
        files = [path]
    kinds = {_kind(file) or file.suffix for file in files}
    if ".bag" in kinds and len(kinds) > 1:
        raise InputError(f"has bags of ROS 1 and of ROS 2; name one of them: {_listed(files)}", path)
    opened = []
    for number, file in enumerate(files):
        if re.search(r"\.zstd?$", file.name, re.IGNORECASE):
            raise InputError(
                f"is compressed, and has no {METADATA} beside it; run zstd -d {file.name}, and name the "
                "file that this writes",
                file,
            )
        kind = _kind(file)
        if kind and file.suffix != kind:
            link = links / f"{number}{kind}"
            link.symlink_to(file.resolve())
            opened.append(link)
        else:
            opened.append(file)
    return opened


def check_spans(spans: list[tuple[float, float]], path: Path) -> None:
    """Raise InputError if the files of a folder, with these first and last times, are not parts of one recording."""
    ordered = sorted(spans)
    if any(begin < end for (_, end), (begin, _) in pairwise(ordered)):
        names = _listed(_files_in(path))
        raise InputError(f"has several bags that were recorded at the same time; name one of them: {names}", path)


def _has_metadata(folder: Path) -> bool:
    """Return whether a folder has metadata that say how its files are stored."""
    path = folder / METADATA
    if not path.is_file():
        return False
    text = path.read_text(encoding="utf-8", errors="replace")
    found = re.search(r"^\s*storage_identifier:[ \t]*(.*?)[ \t]*$", text, re.MULTILINE)
    return found is None or bool(found[1].strip("'\""))


def _files_in(folder: Path) -> list[Path]:
    files = [file for file in folder.iterdir() if NAMES.fullmatch(file.name) and file.is_file()]
    return sorted(files, key=lambda file: natural_order(file.name))


def _has_images(folder: Path) -> bool:
    try:
        return len(list_images(folder)) > 0
    except SpecError:
        return (folder / "rgb.txt").is_file()


def _kind(file: Path) -> str:
    """Return the suffix of a file's kind by its first bytes; empty if they are of no bag."""
    try:
        with file.open("rb") as stream:
            first = stream.read(16)
    except OSError:
        return ""
    return next((suffix for magic, suffix in SUFFIXES.items() if first.startswith(magic)), "")


def _listed(files: list[Path]) -> str:
    names = [file.name for file in files]
    return ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")

"""The list file of pairs: one ``first second label`` per line, after comment lines with the settings.

A name that contains blanks, or begins with ``#``, is in double quotes.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from loopclosure.errors import InputError
from netspec.files.whole_file import write_whole

ROOT_FOLDER = (
    "root folder"  # this setting is the folder that image names are relative to, itself relative to the list's folder
)


_WORD = re.compile(r'"([^"]*)"|(\S+)')


@dataclass(frozen=True)
class ListedPair:
    """One line of a list: two image names below the root folder, and 1 for the same place, 0 for other places."""

    first: str
    second: str
    label: int
    line: int


def write_pair_list(path: Path, pairs: Iterable[tuple[str, str, int]], settings: Mapping[str, str]) -> None:
    """Write a list; ``settings`` become the lines ``# name: value`` of its header.

    Raises InputError for an image name that a list cannot contain, or if the file cannot be written.
    """
    lines = ["# first second label; 1: the same place, 0: other places"]
    lines += [f"# {name}: {value}" for name, value in settings.items()]
    for first, second, label in pairs:
        lines.append(f"{_quoted(first)} {_quoted(second)} {label}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", path) from error
    write_whole(path, "\n".join(lines) + "\n", "surrogateescape")


def read_pair_list(path: Path) -> list[ListedPair]:
    """Read a list. Raises InputError (file:line:column) for a malformed line."""
    pairs = []
    for number, line in enumerate(_read_lines(path), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = [quoted or bare for quoted, bare in _WORD.findall(line)]
        if len(fields) != 3:
            raise InputError(
                f"found {line.strip()!r}, expected two images and a label: a.png b.png 1; "
                "names with blanks go into double quotes",
                path,
                number,
                1,
            )
        if fields[2] not in ("0", "1"):
            column = line.rindex(fields[2]) + 1
            raise InputError(f'a label is 1 (same place) or 0 (other places), not "{fields[2]}"', path, number, column)
        pairs.append(ListedPair(fields[0], fields[1], int(fields[2]), number))
    if not pairs:
        raise InputError("lists no pair", path)
    return pairs


def read_settings(path: Path) -> dict[str, str]:
    """Return the ``# name: value`` lines of a list's header."""
    settings = {}
    for line in _read_lines(path):
        if not line.startswith("#"):
            break
        name, colon, value = line[1:].partition(": ")
        if colon:
            settings[name.strip()] = value.strip()
    return settings


def _quoted(name: str) -> str:
    if '"' in name or "\n" in name:
        raise InputError(f"cannot list the image {name!r}: a name must not contain quotes or line breaks")
    return f'"{name}"' if name.split() != [name] or name.startswith("#") else name


def root_of(path: Path) -> Path:
    """Return the folder that a list's images are relative to: what its header says, or else the list's own folder."""
    return path.parent / read_settings(path).get(ROOT_FOLDER, ".")


def join_lists(lists: Sequence[Path], out: Path, seed: int, root: Path | None = None) -> tuple[int, Path]:
    """Write the pairs of several lists, shuffled together, as one; return their number and the common root folder.

    Image names become relative to ``root`` or to the common parent of the lists' roots.
    """
    roots = [root_of(path).resolve() for path in lists]
    common = Path(os.path.commonpath(roots)) if root is None else root.resolve()
    pairs = []
    for path, own_root in zip(lists, roots, strict=True):
        prefix = Path(os.path.relpath(own_root, common)).as_posix()
        if prefix.startswith(".."):
            raise InputError(
                f"its images are in {own_root}, not below the root folder {common}; give another root", path
            )
        above = "" if prefix == "." else prefix + "/"
        pairs += [(above + pair.first, above + pair.second, pair.label) for pair in read_pair_list(path)]
    order = np.random.default_rng(seed).permutation(len(pairs))
    settings = {
        "source": "the lists " + ", ".join(Path(os.path.relpath(path, out.parent)).as_posix() for path in lists),
        ROOT_FOLDER: Path(os.path.relpath(common, out.parent.resolve())).as_posix(),
        "seed": str(seed),
    }
    write_pair_list(out, (pairs[index] for index in order), settings)
    return len(pairs), common


def _read_lines(path: Path) -> list[str]:
    expected = 'expected lines such as "a.png b.png 1"'
    try:
        text = path.read_text(encoding="utf-8-sig", errors="surrogateescape")  # names of files can be any bytes
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror}); {expected}", path) from error
    if "\0" in text:
        raise InputError(f"cannot be read (not a text file); {expected}", path)
    return text.splitlines()

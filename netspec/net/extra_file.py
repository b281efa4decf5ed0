"""The file ``X.solverstate.extra`` of a snapshot, which has the sizes and hashes of the other files of the snapshot.

Whoever reads ``X.caffemodel`` compares it with its hash, because protobuf reads most damaged files without an error.
The .extra file is JSON. It also has a hash of its own content, because one changed digit would change the results of a
training.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from netspec import log
from netspec.errors import SpecError, Where
from netspec.files.kinds import unreadable

FORMAT = 2
_BLOCK = 1 << 20  # bytes
_SHOWN = 40  # characters of a wrong value
MOST = 2**63 - 1  # the largest whole number in the file
#: The exceptions that reading a damaged JSON file may raise.
FAULTS = (ValueError, TypeError, LookupError, AttributeError, RecursionError, OverflowError)


@dataclass(frozen=True)
class Digest:
    """The size and the hash of a file."""

    size: int
    hash: str

    @classmethod
    def of(cls, path: str | Path) -> Digest:
        """Return the digest of a file. Raises OSError if it cannot be read."""
        size, hashed = 0, hashlib.blake2b(digest_size=16)
        with open(path, "rb") as file:
            while block := file.read(_BLOCK):
                size += len(block)
                hashed.update(block)
        return cls(size, hashed.hexdigest())

    @classmethod
    def read(cls, value: Any) -> Digest:
        """Return the digest that is written as ``value`` in JSON. Raises one of FAULTS for anything else."""
        size, hashed = value["size"], value["hash"]
        if not isinstance(hashed, str):
            raise ValueError(f"found hash {shown(hashed)}, expected a text")
        return cls(whole_number(size, "size"), hashed)

    def check(self, path: Path, extra: Path) -> None:
        """Raise SpecError if a file is not the one that was written together with ``extra``."""
        if Digest.of(path) != self:
            message = f"is not the file that was written with {extra.name}: it was truncated or replaced"
            raise SpecError(f"{message}; if you replaced it intentionally, remove {extra.name}", Where(str(path)))


def whole_number(value: Any, name: str, most: int = MOST) -> int:
    """Return a value of JSON that is a whole number from 0 to ``most``. Raises ValueError for any other value."""
    if type(value) is not int or not 0 <= value <= most:
        raise ValueError(f"found {name} {shown(value)}, expected a whole number")
    return value


def shown(value: Any) -> str:
    """Return a wrong value as text for an error message, shortened if it is long."""
    text = f"a number of {value.bit_length()} bits" if type(value) is int and abs(value) > MOST else repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def extra_text(content: Mapping[str, Any]) -> str:
    """Return the text of an .extra file: the content, the format, and the hash of both."""
    whole = {"format": FORMAT, **content}
    return json.dumps({**whole, "hash": _hash(whole)}, indent=1) + "\n"


def read_content(path: Path) -> dict[str, Any]:
    """Return the content of an .extra file. Raises FileNotFoundError, and SpecError for any other fault."""
    try:
        found = json.loads(path.read_text("utf-8"))
        if found["format"] != FORMAT or type(found["format"]) is not int:
            raise ValueError(f"found format {shown(found['format'])}, expected {FORMAT}")
        if found.pop("hash") != _hash(found):
            raise ValueError("its hash does not match")
        return found
    except FileNotFoundError:
        raise
    except OSError as fault:
        raise SpecError(unreadable(path, fault), Where(str(path))) from None
    except FAULTS as fault:
        raise damaged(path, fault) from None


def damaged(path: Path, reason: Exception) -> SpecError:
    """Return the error of an .extra file that cannot be understood."""
    found = f"no {reason}" if isinstance(reason, KeyError) else " ".join(str(reason).split())
    return SpecError(f"is damaged ({found}); if you remove it, the training resumes as in Caffe", Where(str(path)))


def check_weights(path: Path) -> None:
    """Compare ``X.caffemodel`` with its hash in ``X.solverstate.extra``. Raises SpecError if it is another file.

    Without an .extra file there is nothing to compare. If that file is damaged, a warning says so.
    """
    found = re.fullmatch(r"(.+)\.caffemodel(\.h5)?", path.name)
    extra = path.with_name(f"{found[1]}.solverstate{found[2] or ''}.extra") if found else None
    if extra is None or not extra.is_file() or not path.is_file():
        return
    try:
        digest = Digest.read(read_content(extra)["weights"])
    except SpecError as fault:
        log.logger.warning(f"{fault}; {path.name} was not checked against it")
        return
    except FAULTS:
        return
    digest.check(path, extra)


def _hash(content: Mapping[str, Any]) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

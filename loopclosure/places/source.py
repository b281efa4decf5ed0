"""A source of images in one word, ``[KIND:]PATH[,KEY=VALUE]...``, with what belongs to it: its frames, its poses."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from loopclosure.errors import InputError
from loopclosure.places.frames import Selection
from loopclosure.places.pose_files import pose_form
from loopclosure.places.sequences import PoseChoice
from netspec.errors import did_you_mean

FRAMES = ("start", "stop", "stride", "limit")
POSES = ("poses", "pose-form")
TOPICS = ("topic", "pose-topic")
Kinds = Mapping[str, Sequence[str]]  # the settings of each kind of source, "" for one whose kind is not named
T = TypeVar("T")


@dataclass(frozen=True)
class Source:
    """A folder or file. ``kind`` is "" where its own files tell it; ``settings`` are the texts of what was set."""

    kind: str
    path: Path
    settings: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return ",".join((str(self.path), *(f"{key}={value}" for key, value in self.settings.items())))

    def get(self, name: str, read: Callable[[str], T]) -> T | None:
        """Return a setting, None where it is absent. Raises InputError where ``read`` finds no such value."""
        if name not in self.settings:
            return None
        try:
            return read(self.settings[name])
        except InputError:
            raise
        except ValueError:
            raise InputError(f'{self}: {name} is "{self.settings[name]}", expected a number') from None

    def selection(self) -> Selection:
        """Return which of its frames are taken."""
        stride, limit = self.get("stride", int), self.get("limit", int)
        return Selection(self.get("start", str) or 0, self.get("stop", str), 1 if stride is None else stride, limit)

    def pose_choice(self) -> PoseChoice | None:
        """Return the file of poses that replaces the sequence's own, if one is named."""
        poses = self.get("poses", Path)
        return PoseChoice(poses, self.get("pose-form", pose_form) or pose_form("")) if poses else None


def read_source(text: str, kinds: Kinds) -> Source:
    """Read a source. Raises InputError for a setting that its kind does not have.

    A word before a colon that names no kind belongs to the path, as ``C:`` does. A comma ends the path only before
    ``KEY=``.
    """
    kind, colon, rest = text.partition(":")
    if not (colon and kind in kinds):
        hint = did_you_mean(kind, [name for name in kinds if name])
        if colon and hint and not Path(text).exists():
            raise InputError(f'there is no kind of source "{kind}"{hint}')
        kind, rest = "", text
    path, *parts = re.split(r",(?=[a-z-]+=)", rest)
    settings = dict(part.split("=", 1) for part in parts)
    for name in settings:
        if name not in kinds[kind]:
            hint = did_you_mean(name, list(kinds[kind])) or f"; it has: {', '.join(kinds[kind]) or 'none'}"
            raise InputError(f'{text}: {kind or "a sequence"} has no setting "{name}"{hint}')
    if "pose-form" in settings and "poses" not in settings:
        raise InputError(f"{text}: pose-form means nothing without poses")
    return Source(kind, Path(path), settings)

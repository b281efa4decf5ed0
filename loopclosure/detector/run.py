"""The detector on a whole sequence of images or a video, with any descriptor."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, cast

import numpy as np

from loopclosure.descriptors.feature_file import Features
from loopclosure.detector.decision import LoopResult
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.saved import Describe
from loopclosure.detector.visitor import Visitor
from loopclosure.errors import InputError
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.same_place import same_place
from loopclosure.places.trajectory import Poses
from loopclosure.progress import Progress, silent

DESCRIBERS = "loopclosure.describers"  # the group of entry points: name -> function that makes a describer
NAME = r"[\w-]+"  # the form of a name in that group
OWN = ("netspec", "loopclosure", "lmdb_build")  # one distribution; a checkout of it may be the working directory


@dataclass(frozen=True)
class _Frame:
    """The stamp of a frame in seconds, its true pose and its odometry (7,), None where not known."""

    stamp: float | None
    pose: np.ndarray | None
    odometry: np.ndarray | None

    @classmethod
    def of(cls, sequence: ImageSequence, i: int, stamp: float | None) -> _Frame:
        """Return what is known of a frame of a sequence."""
        rows = [None if path is None else path[i] for path in (sequence.poses, sequence.odometry)]
        return cls(stamp, *(row if row is not None and np.isfinite(row).all() else None for row in rows))


def run_detector(
    detector: LoopDetector | Visitor,
    sequence: ImageSequence,
    features: Features | None = None,
    progress: Progress = silent,
) -> list[LoopResult]:
    """Add every frame of a sequence; ``features``, with a descriptor of each image, replace ``describe``.

    Images that cannot be read are left out: the frames are then those of ``sequence.readable()``.
    """
    results = list[LoopResult]()
    for row, image, frame in _described(sequence, features, detector.check is not None, progress):
        path = frame.pose, frame.odometry
        if row is not None:
            put(results, detector.add_descriptor(row, frame.stamp, path[0], image, path[1]))
        else:
            assert image is not None
            put(results, detector.add(image, frame.stamp, *path))
    return results


def put(results: list[LoopResult], result: LoopResult) -> None:
    """Append the result of the next frame, and replace those of earlier frames whose loops it completes."""
    for late in result.late:
        if (number := len(results) - (result.query_id - late.query_id)) >= 0:
            results[number] = late
    results.append(result)


def remember_all(
    detector: LoopDetector, sequence: ImageSequence, features: Features | None = None, progress: Progress = silent
) -> None:
    """Add all frames as :func:`run_detector` does, without looking for loops; see :meth:`LoopDetector.remember`."""
    for row, image, frame in _described(sequence, features, detector.check is not None, progress):
        detector.remember(row, frame.stamp, frame.pose, image, frame.odometry)


def _described(
    sequence: ImageSequence, features: Features | None, checked: bool, progress: Progress
) -> Iterator[tuple[np.ndarray | None, np.ndarray | None, _Frame]]:
    """Yield the descriptor and the image of each frame, None for what is not needed, and what else is known of it.

    ``checked``: read the images for a geometric check, even if their descriptors are known.
    """
    rows = None
    if features is not None:
        if not sequence.paths:
            raise InputError("the frames of a video have no names to find features by; use --describe", features.path)
        rows = features.rows_of(sequence.paths)
    if rows is not None and not checked:
        for i, row in enumerate(progress(rows, "frames", len(rows))):
            yield row, None, _Frame.of(sequence, i, None if sequence.stamps is None else float(sequence.stamps[i]))
        return
    for i, image, stamp in progress(sequence.frames(), "frames", len(sequence)):
        yield None if rows is None else rows[i], image, _Frame.of(sequence, i, stamp)


def verdicts_said(results: Sequence[LoopResult]) -> str:
    """Return a sentence that counts the verdicts and gives the best score."""
    verdicts = [result.verdict for result in results]
    words = ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in dict.fromkeys(verdicts))
    scores = [result.score for result in results if result.candidates]
    return f"frames: {words}" + (f"; best score {max(scores) + 0.0:.4g}" if scores else "")


def judged_by_poses(detector: LoopDetector) -> str:
    """Return a sentence that counts the accepted loops which are the same place by the paper's rule.

    Only loops with two known poses count.
    """
    poses = detector.poses
    ends = np.array([(loop.query_id, loop.accepted) for loop in detector.loops], int).reshape(-1, 2)
    known = ends[np.all(np.isfinite(poses[ends]), axis=(1, 2))]
    a, b = (Poses(poses[column, :3], poses[column, 3:]) for column in known.T)
    right = int(np.count_nonzero(same_place(a, b)))
    return f"{right} of {len(known)} loops are the same place by their poses (2 m, 15 degrees)"


def load_describe(specification: str, options: dict[str, str] | None = None) -> Describe:
    """Return the ``describe`` function that ``module:name`` or ``FILE.py:name`` names, or a name without a colon.

    A name without a colon is an entry point in the group ``loopclosure.describers`` of an installed package. It is
    always called with ``options``.
    A class, a function if there are options, and a function that cannot take one image are called with ``options`` as
    keywords and must return the ``describe`` function.
    A module must belong to an installed package; a file in the working directory runs only if its path is given.
    """
    options = options or {}
    if re.fullmatch(NAME, specification):
        return _called(_entry_point(specification), specification, options)
    module_name, colon, name = specification.rpartition(":")
    if not colon or not name or not module_name:
        raise InputError(f'"{specification}" does not name a function; expected module:function or FILE.py:function')
    try:
        target: Any = _file_module(Path(module_name)) if module_name.endswith(".py") else _installed_module(module_name)
    except (ImportError, SyntaxError, OSError) as error:
        raise InputError(f'cannot import "{module_name}" of --describe {specification}: {error}') from error
    for part in name.split("."):
        if not hasattr(target, part):
            raise InputError(f'"{module_name}" has no "{name}" (--describe {specification})')
        target = getattr(target, part)
    if options or isinstance(target, type) or not _takes_an_image(_callable(target, specification)):
        return _called(target, specification, options)
    return _callable(target, specification)


def _takes_an_image(function: Describe) -> bool:
    """Return whether a function can be called with one argument; True where that is not known."""
    try:
        inspect.signature(function).bind(None)
    except TypeError:
        return False
    except ValueError:  # a function in C may have no signature
        return True
    return True


def _called(target: Any, specification: str, options: dict[str, str]) -> Describe:
    try:
        return _callable(target(**{key: _value(text) for key, text in options.items()}), specification)
    except (TypeError, ValueError, OSError) as error:
        raise InputError(f"--describe {specification}: {error}") from error


def _callable(target: Any, specification: str) -> Describe:
    if not callable(target):
        raise InputError(f"--describe {specification} is a {type(target).__name__}, which cannot be called")
    return cast(Describe, target)


def _entry_point(name: str) -> Any:
    found = entry_points(group=DESCRIBERS)
    if name not in found.names:
        known = ", ".join(sorted(found.names)) or "none is installed: install the package again (pip install)"
        raise InputError(f'no describer has the name "{name}"; expected module:function, or a name ({known})')
    try:
        return found[name].load()
    except (ImportError, AttributeError) as error:
        raise InputError(f"--describe {name}: {found[name].value} cannot be imported: {error}") from error


def _installed_module(name: str) -> Any:
    here, top = Path.cwd(), name.partition(".")[0]
    found = importlib.util.find_spec(top)
    origins = [] if found is None else [found.origin, *(found.submodule_search_locations or ())]
    near = [here / f"{top}.py", here / top / "__init__.py", here / top]
    lies_here = any(origin and Path(origin) in near for origin in origins)
    if top not in OWN and (lies_here or (found is None and any(path.exists() for path in near))):
        path = "/".join(name.split(".")) + ".py"
        raise InputError(
            f'"{name}" lies in the working directory, not in an installed package; name its file: ./{path}'
        )
    return importlib.import_module(name)


def _file_module(path: Path) -> Any:
    """Run a file as a module. Its folder is searched for imports after the installed packages."""
    spec = importlib.util.spec_from_file_location(f"_describe_{path.stem}", path)
    assert spec is not None, "the path ends in .py"
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    sys.path.append(str(path.resolve().parent))
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(path.resolve().parent))
    return module


def views_of(describe: Describe | None, features: Features | None) -> int:
    """Return the number of views per image: of the features, or the ``views`` attribute of ``describe`` (default 1)."""
    return getattr(describe, "views", 1) if features is None else features.views


def _value(text: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text

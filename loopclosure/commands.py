"""The commands ``detect``, ``close`` and ``evaluate`` as functions: they write the same files and return the result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from loopclosure import evaluation
from loopclosure.closing.close import Closed, constraint, drifted, write_closed
from loopclosure.closing.close import close as close_loops
from loopclosure.closing.measure import Loop, cells, depth_scale_said, errors_said, measure, read_loops
from loopclosure.decision.constants import PRECISION
from loopclosure.descriptors.feature_file import read_features
from loopclosure.detector import run
from loopclosure.detector.decision import LoopResult
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.export import RELATIVE, write_g2o, write_loops_csv
from loopclosure.detector.saved import Describe
from loopclosure.errors import InputError
from loopclosure.methods.base import MethodContext
from loopclosure.methods.drive import Request, whole_drive
from loopclosure.methods.named import named_methods
from loopclosure.opening import data_set, known_camera, readable, recording_of, sequence, typed
from loopclosure.places.frames import image_paths
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.intrinsics import FORM, Intrinsics
from loopclosure.places.source import CLOSED, FRAMES
from loopclosure.places.trajectory import pieces
from netspec.files.whole_file import write_whole
from netspec.terminal.output import bar, warn


@dataclass(frozen=True)
class Detected:
    """What ``detect`` found.

    recording  the frames that could be read
    results    what was decided about each of them
    reasons    sentences: what was chosen and why, and how many loops are right if poses are known
    """

    recording: ImageSequence
    results: list[LoopResult]
    reasons: list[str]

    @property
    def loops(self) -> list[LoopResult]:
        """The results that are loops."""
        return [result for result in self.results if result]


def detect(
    source: str | Path,
    out: str | Path,
    *,
    describe: str | Path | Describe = "default",
    metric: str = "euclidean",
    exclude_recent: int | None = None,
    exclude_seconds: float = 0.0,
    odometry: str | Path | None = None,
    camera: str | Intrinsics | None = None,
    least_precision: float = PRECISION,
    command: str = "",
) -> Detected:
    """Find the loops of a recording, decided from all of its frames; the same as ``loopclosure detect``.

    The folder ``out`` gets loops.csv, report.html, chosen.txt with the reasons and, with poses or odometry, loops.g2o.

    describe  an included net, "default" or "small"; ``module:function``, ``FILE.py:function`` or a function from an
              image (H, W, 3) uint8 BGR to its descriptor; or a file F.npz that ``netspec extract --images`` wrote
    command   the command line, which the report shows

    The other arguments are the options of the command. Raises InputError for files that cannot be used.
    """
    out = Path(out)
    recording = recording_of(source, out / "frames", camera, odometry)
    features = read_features(describe) if isinstance(describe, str | Path) and str(describe).endswith(".npz") else None
    limits = {"metric": metric, "exclude_recent": exclude_recent, "exclude_seconds": exclude_seconds}
    if features is None:
        detector = LoopDetector(describe if callable(describe) else str(describe), check=None, **limits)
    else:
        detector = LoopDetector(None, check=None, views=features.views, **limits)
    path = recording.odometry  # after a jump, its poses are in another frame
    whole = path is not None and not pieces(path, recording.stamps).any()
    found = whole_drive(
        detector, recording, features, Request(least_precision, exclude_recent, odometry=path if whole else None), bar
    )
    recording = readable(recording)
    reasons = [*found.reasons, run.verdicts_said(found.results)]
    if engine := getattr(detector.describe, "engine", ""):
        reasons.append(f"descriptors: computed by {engine}")
    loops, measured = [Loop(loop.query, loop.match) for loop in detector.loops if loop.match is not None], None
    if recording.camera is not None:
        loops = measure(recording, loops, recording.camera, recording.odometry, bar)
        if said := depth_scale_said(recording, recording.camera):
            warn(said)
        measured = RELATIVE, {loop.query: cells(loop.relative) for loop in loops if loop.relative is not None}
    write_loops_csv(out / "loops.csv", detector.loops, detector.stamps, recording.names, measured=measured)
    reasons += _write_graph(out / "loops.g2o", detector, loops)
    write_whole(out / "chosen.txt", "\n".join(reasons) + "\n")
    # Drawing takes a second to import.
    from loopclosure.report.drive import write_drive

    write_drive(out / "report.html", found.results, reasons, recording, command)
    if recording.unreadable:
        warn(f"{len(recording.unreadable)} images cannot be read; the report shows no pairs with them")
    return Detected(recording, found.results, reasons)


def _write_graph(out: Path, detector: LoopDetector, loops: Sequence[Loop]) -> list[str]:
    """Write the pose graph of a drive if its path is known; return sentences about it and about the true poses."""
    poses, odometry, said = detector.poses, detector.odometry, []
    driven, known = np.isfinite(odometry).any(), np.isfinite(poses).any()
    if driven or known:
        edges = {(loop.query, loop.match): constraint(loop.relative) for loop in loops if loop.relative is not None}
        path = odometry if driven else poses
        left_out = write_g2o(
            out, path, detector.loops, lambda *ends: edges.get(ends), pieces(path, detector.stamps, detector.sessions)
        )
        note = f"; loops without a measured relative pose, left out: {left_out}" if left_out else ""
        said.append(f"pose graph of the {'odometry' if driven else 'known poses'}{note}: {out}")
    if known:
        said += [run.judged_by_poses(detector), *filter(None, [errors_said(loops, poses)])]
    return said


def close(
    source: str | Path,
    loops: str | Path,
    out: str | Path,
    *,
    odometry: str | Path | None = None,
    odometry_form: str | None = None,
    drift: float | None = None,
    seed: int = 1,
    camera: str | Intrinsics | None = None,
) -> Closed:
    """Correct the path of a recording by its loops; the same as ``loopclosure close``.

    The folder ``out`` gets closed.g2o, closed.txt, odometry.txt, loops.csv and paths.png.

    loops  the loops.csv that ``detect`` wrote
    drift  percent; simulate odometry that drifts from the true poses, with this ``seed``

    The other arguments are the options of the command. Raises InputError for files that cannot be used.
    """
    out, given = Path(out), known_camera(camera)
    chosen = typed(source, CLOSED)
    frames = sequence(chosen, out / "frames", odometry=odometry, form=odometry_form)
    known = given or frames.camera
    if known is None:
        raise InputError(f"has no camera calibration; give --camera {FORM}", frames.source)
    path = _path(frames, drift, seed)[chosen.selection().numbers(len(frames))]
    frames = frames.taken(chosen.selection())
    measured = measure(frames, read_loops(Path(loops), frames), known, path, bar)
    if drift is None and (said := depth_scale_said(frames, known)):
        warn(said)
    closed = close_loops(path, measured, frames.poses, stamps=frames.stamps)
    write_closed(out, closed, frames.stamps, frames.names)
    # Drawing takes a second to import.
    from loopclosure.report.plots import draw_paths

    draw_paths(out / "paths.png", closed)
    return closed


def _path(frames: ImageSequence, drift: float | None, seed: int) -> np.ndarray:
    """Return the path (F, 7) to correct, NaN for frames without a pose. Raises InputError if there is none."""
    if drift is None:
        if frames.odometry is None:
            raise InputError("has no odometry; give --odometry FILE, or --drift PERCENT to simulate it", frames.source)
        return frames.odometry
    if frames.poses is None:
        raise InputError(
            "has no true poses to simulate drift from; give --odometry, or add ,poses=FILE to the source", frames.source
        )
    known = np.all(np.isfinite(frames.poses), axis=1)
    path = frames.poses.copy()
    path[known] = drifted(path[known], drift, seed)
    return path


def evaluate(
    source: str | Path,
    methods: Sequence[str],
    out: str | Path,
    *,
    settings: Mapping[str, str] | None = None,
    train: Sequence[str | Path] = (),
    title: str = "",
    seed: int = 0,
    tolerance: int | None = None,
    max_distance: float | None = None,
    max_angle: float | None = None,
    exclude_frames: int | None = None,
    exclude_seconds: float | None = None,
    command: str = "",
) -> evaluation.Evaluation:
    """Run methods on a data set and judge them by its ground truth; the same as ``loopclosure evaluate``.

    The folder ``out`` gets report.html, its pictures, and report.json.

    methods   names such as "thumbnails", or LABEL=METHOD
    settings  "NAME.SETTING" -> value, by the name or label of a method
    train     sources of images to train vocabularies on
    command   the command line, which the report shows

    The other arguments are the options of the command. Raises InputError for files that cannot be used.
    """
    # Drawing takes a second to import.
    from loopclosure.report.page import write_report

    data = data_set(source, Path(out), tolerance, max_distance, max_angle, exclude_frames, exclude_seconds)
    named = named_methods(methods, MethodContext(data.exclude_frames, seed), dict(settings or {}))
    sources, images = [typed(each, {"": FRAMES}) for each in train], list[Path]()
    for each in sources:
        paths = image_paths(each.path)
        images += [paths[i] for i in each.selection().numbers(len(paths))]
    trained = f"{len(images)} images of {', '.join(each.path.name for each in sources)}" if images else ""
    found = evaluation.evaluate(data, named, images, trained or "no training images", bar)
    write_report(found, out, title, command)
    return found

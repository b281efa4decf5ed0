"""Parses a source of images, ``[KIND:]PATH[,KEY=VALUE]...``, and extracts the frames of bags and videos."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from loopclosure.errors import InputError
from loopclosure.places.bags import BY_NAME, NO_POSES, Topics, is_bag, open_bag, right
from loopclosure.places.frames import Selection, is_video, video_frames, video_length, write_picture
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.intrinsics import write_calibration
from loopclosure.places.masks import CAMERAS
from loopclosure.places.pose_files import WORDS, pose_form
from loopclosure.places.sequences import GROUNDTRUTH, ODOMETRY, PoseChoice, benchmark_parts, layout_of, read_sequence
from loopclosure.places.trajectory import MAX_DIFFERENCE_S, write_rgb_list, write_trajectory
from loopclosure.progress import Progress, silent
from netspec.errors import did_you_mean
from netspec.files.kinds import nearest_existing
from netspec.files.opencv import cv2
from netspec.files.whole_file import whole_folder

FRAMES = ("start", "stop", "stride", "limit")
POSES = ("poses", "pose-form")
READ = ("times", "depth-scale")  # how a sequence is read
TOPICS = ("topic", "pose-topic", "odometry-topic")
Kinds = Mapping[str, Sequence[str]]  # the settings of each kind of source; "" if no kind is named
Listed = list[tuple[float, str]]  # the stamp in seconds and the file of each frame
T = TypeVar("T")
SEQUENCE = (*FRAMES, *POSES, *READ, "references")
# The settings of each kind of source: for an evaluation (loopclosure evaluate) and for pairs of images
# (lmdb-build pairs). None: the command does not accept this kind.
_KINDS: dict[str, tuple[Sequence[str] | None, Sequence[str] | None]] = {
    "": ((*SEQUENCE, *TOPICS, "truth"), (*POSES, *READ, *TOPICS, "truth", "camera")),
    "tum": (SEQUENCE, (*POSES, *READ, *TOPICS)),
    "euroc": (SEQUENCE, (*POSES, *READ, *TOPICS)),
    "kitti": (SEQUENCE, (*POSES, *READ, *TOPICS)),
    "bag": ((*SEQUENCE, *TOPICS), (*POSES, *READ, *TOPICS)),
    "video": (SEQUENCE, (*POSES, *READ, *TOPICS)),
    "images": ((*SEQUENCE, "truth"), (*POSES, *READ, "truth", "camera")),
    "traverses": ((*FRAMES, "references", "truth"), ("references", "truth")),
    "nordland": (FRAMES, ()),
    "fabmap": ((*FRAMES, "truth", "camera", "coordinates"), None),
    "pairs": (FRAMES, None),
    "folders": (None, ("references",)),
}
EVALUATED = {kind: settings for kind, (settings, _) in _KINDS.items() if settings is not None}
PAIRED = {kind: settings for kind, (_, settings) in _KINDS.items() if settings is not None}
# The settings for detect and map, and for close. These commands take one sequence and detect its kind from the files.
DETECTED: Kinds = {"": (*FRAMES, *READ, *TOPICS)}
CLOSED: Kinds = {"": (*FRAMES, *POSES, *READ, *TOPICS)}


@dataclass(frozen=True)
class Source:
    """A folder or file. ``kind`` is "" if it must be detected from the files; ``settings`` are not parsed yet."""

    kind: str
    path: Path
    settings: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return ",".join((str(self.path), *(f"{key}={value}" for key, value in self.settings.items())))

    def get(self, name: str, read: Callable[[str], T]) -> T | None:
        """Return a setting parsed by ``read``, or None if it is absent. Raises InputError if it cannot be parsed."""
        if name not in self.settings:
            return None
        try:
            return read(self.settings[name])
        except InputError:
            raise
        except ValueError:
            raise InputError(f'{self}: {name} is "{self.settings[name]}", expected a number') from None

    def selection(self) -> Selection:
        """Return the selection of frames."""
        stride, limit = self.get("stride", int), self.get("limit", int)
        return Selection(self.get("start", str) or 0, self.get("stop", str), 1 if stride is None else stride, limit)

    def pose_choice(self) -> PoseChoice | None:
        """Return the file of poses that replaces the sequence's own, or None."""
        poses = self.get("poses", Path)
        return PoseChoice(poses, self.get("pose-form", pose_form) or pose_form("")) if poses else None


def read_source(text: str, kinds: Kinds) -> Source:
    """Read a source. Raises InputError for a setting that its kind does not have.

    If the text before a colon is not a kind, it belongs to the path, for example ``C:``. A comma ends the path only if
    ``KEY=`` follows.
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
        raise InputError(f"{text}: pose-form needs poses")
    return Source(kind, Path(path), settings)


def resolved(source: Source) -> Source:
    """Return a source with its kind, "" for sequences with poses, and with the files that a kind implies.

    A VPR benchmark (``nordland``) is two traverses. Raises InputError if a setting is missing.
    """
    path, settings = source.path, dict(source.settings)
    kind = source.kind or ("images" if "truth" in settings else "")
    if kind in LAYOUTS or (kind == "images" and "poses" in settings):
        kind = "" if kind == "images" else kind
    elif kind == "nordland":
        kind, (path, references, truth) = "traverses", benchmark_parts(path)
        settings |= {"references": str(references), "truth": str(truth)}
    for name in NEEDED.get(kind, ()):
        if name not in settings:
            raise InputError(f"{kind}:{source} needs ,{name}=...")
    camera = settings.get("camera", CAMERAS[0])
    if camera not in CAMERAS:
        raise InputError(f'{source}: camera is "{camera}", expected {", ".join(CAMERAS)}')
    return Source(kind, path, settings)


# The settings that a kind of source cannot do without.
NEEDED = {
    "images": ("truth",),
    "traverses": ("references",),
    "folders": ("references",),
}
MADE_FROM = "source.txt"  # the file and topics, then a line for each doubt about them
MADE_BY = 2  # the version of what extract writes
# The sequences with poses, as the help texts describe them.
LAYOUTS = {
    "tum": "a TUM RGB-D sequence",
    "euroc": "an EuRoC sequence (mav0/)",
    "kitti": "a KITTI odometry sequence (sequences/00)",
    "bag": "a ROS 1 or ROS 2 bag",
    "video": "a video (with poses)",
}
LAYOUT_LINES = "\n".join(f"  {kind + ':':11} {what}" for kind, what in LAYOUTS.items())
POSES_HELP = "camera poses in the format of TUM, KITTI or EuRoC, instead of the sequence's own"
POSE_FORM_HELP = (
    f"format of the poses, if not detected from the file: one or more of "
    f"{', '.join(word for words in WORDS.values() for word in words)}, separated by commas"
)


def is_recording(source: Path) -> bool:
    """Return whether a source is a bag or a video."""
    return is_bag(source) or is_video(source)


def open_sequence(
    source: Source,
    frames: Path,
    *,
    posed: bool = False,
    videos: bool = False,
    max_difference: float = MAX_DIFFERENCE_S,
    progress: Progress = silent,
) -> tuple[ImageSequence, str]:
    """Read a sequence with all its frames; return it, and a sentence if its frames were extracted.

    frames          folder for the frames of a bag, see :func:`extract`
    posed           a folder that has no other layout must be a TUM sequence
    videos          extract the frames of videos, too
    max_difference  between an image and its pose, in seconds
    """
    path, layout, poses = source.path, source.kind, source.pose_choice()
    topics = Topics(*(source.get(name, str) or "" for name in TOPICS))
    video = layout == "video" or (not layout and is_video(path))
    times, scale = source.get("times", Path), source.get("depth-scale", float)
    if scale is not None and not 0 < scale < np.inf:
        raise InputError(f"{source}: depth-scale is {scale:g}; expected the value of a meter, as 5000 or 1000")
    if layout == "bag" or (not layout and is_bag(path)) or (video and videos):
        extracted = extract(path, frames, topics, progress)
        sequence = read_sequence(extracted.folder, "images", max_difference, poses, times)
        doubts = tuple(f"{path}: {doubt}" for doubt in extracted.doubts)
        fault = InputError(extracted.pose_fault, path) if extracted.pose_fault and poses is None else None
        return replace(sequence, doubts=(*doubts, *sequence.doubts), pose_fault=fault), extracted.said
    if topics != BY_NAME:
        raise InputError(f"is no bag; {', '.join(TOPICS)} are for bags", path)
    layout = layout or layout_of(path, "tum" if posed and poses is None else "images")
    sequence = read_sequence(path, layout, max_difference, poses, times)
    return sequence if scale is None else replace(sequence, depth_per_m=scale), ""


@dataclass(frozen=True)
class Extracted:
    """The folder with the frames of a bag or video, and a sentence about it.

    doubts      sentences about what looks wrong in the bag
    pose_fault  why there are no poses, if there are several topics with poses
    """

    folder: Path
    said: str
    doubts: Sequence[str] = ()
    pose_fault: str = ""


def extract(source: Path, folder: Path, topics: Topics = BY_NAME, progress: Progress = silent) -> Extracted:
    """Write the frames of a bag or video to a new ``folder`` in TUM's layout.

    rgb/ has the images as PNG, and rgb.txt their times. groundtruth.txt, odometry.txt and calibration.txt are written
    if a bag has poses, odometry and a CameraInfo. An existing folder that was made from the same file and topics is not
    written again.
    Raises InputError if there is another folder of that name, or if the source cannot be read.
    """
    if not source.exists():
        raise InputError(f"no such file{nearest_existing(source)}", source)
    state, names = source.stat(), (topics.images, topics.poses, topics.odometry)
    made_from = f"{source.resolve()} {state.st_size} {state.st_mtime_ns} {MADE_BY} {' '.join(names)}".rstrip()
    if folder.exists():
        known, *notes = _lines(folder / MADE_FROM)
        if known == made_from:
            fault = next((note for note in notes if note.startswith(NO_POSES)), "")
            doubts = [note for note in notes if note != fault]
            return Extracted(folder, f"{source}: its frames are in {folder} already", doubts, fault)
        raise InputError(f"already exists, and was not made from {source}; remove it, or give another --out", folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with whole_folder(folder) as unfinished:
        (unfinished / "rgb").mkdir()
        write = _bag if is_bag(source) else _video
        frames, about = write(source, unfinished, topics, progress)
        write_rgb_list(unfinished / "rgb.txt", frames)
        notes = [*about.doubts, *filter(None, [about.pose_fault])]
        (unfinished / MADE_FROM).write_text("\n".join([made_from, *notes]) + "\n", encoding="utf-8")
    return replace(about, folder=folder, said=f"{source}: {len(frames)} frames{about.said}: {folder}")


def _lines(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8").splitlines() or [""] if path.is_file() else [""]


def _bag(source: Path, folder: Path, topics: Topics, progress: Progress) -> tuple[Listed, Extracted]:
    with open_bag(source, topics) as bag:
        times = []

        def images() -> Iterator[tuple[float, np.ndarray]]:
            for stamp, received, image in bag.images():
                times.append((stamp, received))
                yield stamp, image

        files = [file for _, file in _write_images(folder, progress(images(), source.name, bag.count))]
        if not files:
            raise InputError(f"has no image in {bag.topics.images}", source)
        about = [f" of {bag.topics.images}"]
        camera = bag.camera()
        if camera is not None:
            write_calibration(folder / "calibration.txt", camera)
        tracks = {name: path for name, path in ((GROUNDTRUTH, bag.poses()), (ODOMETRY, bag.odometry())) if path}
        # Stamps of all topics, or times of receipt of all: two clocks may differ.
        recorded = [np.array(times), *(path.times for path in tracks.values())]
        column = 0 if all(right(each[:, 0]) for each in recorded) else 1
        if column:
            bag.doubts.append("a topic has stamps that are 0, equal or go back; times of receipt are used instead")
        stamps = recorded[0][:, column].tolist()
        for name, path in tracks.items():
            write_trajectory(folder / name, path.times[:, column], path.poses, name.removesuffix(".txt"))
            about.append(path.about)
    return list(zip(stamps, files, strict=True)), Extracted(folder, ", ".join(about), bag.doubts, bag.pose_fault)


def _video(source: Path, folder: Path, topics: Topics, progress: Progress) -> tuple[Listed, Extracted]:
    if topics != BY_NAME:
        raise InputError("is a video, which has no topics", source)
    frames = _write_images(folder, progress(video_frames(source), source.name, video_length(source)))
    return frames, Extracted(folder, "")


def _write_images(folder: Path, images: Iterable[tuple[float, np.ndarray]]) -> Listed:
    frames = []
    for number, (stamp, image) in enumerate(images):
        name = f"rgb/{number:06d}.png"
        write_picture(folder / name, image, cv2.IMWRITE_PNG_COMPRESSION, 1)
        frames.append((stamp, name))
    return frames

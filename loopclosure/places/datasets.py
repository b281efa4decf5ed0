"""Loads data sets with ground truth: sequences with poses, FAB-MAP, folders with masks, traverses, pairs of places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from loopclosure.errors import InputError
from loopclosure.places.frames import ALL_FRAMES, Selection, image_paths
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.masks import (
    comparable,
    images_of_places,
    mask_of_places,
    read_coordinates,
    read_matches,
    read_place_pairs,
    read_truth_matrix,
)
from loopclosure.places.same_place import MAX_ANGLE_DEG, MAX_DISTANCE_M, WIDE_ANGLE_DEG, same_place_matrix
from loopclosure.places.truth import Exclusion, Truth, sequence_truth, traverse_truth

# Ten seconds are usual for TUM's 30 Hz sequences; the other sets have no stamps.
TUM_EXCLUSION = Exclusion(seconds=10.0)
# In the mask of New College, no loop is shorter than 142 images (71 pairs of left and right).
FABMAP_EXCLUSION = Exclusion(frames=50)
FOLDER_EXCLUSION = Exclusion(frames=10)
COMMON_NAMES = ("images", "image", "rgb", "samples", "query", "ref", "reference", "frames")


@dataclass(frozen=True)
class DataSet:
    """One or two sequences of frames, and the truth about them. Methods get the frames alone, as their ``Images``.

    queries         Q frames
    references      R frames, or None for one sequence that visits its own places again
    truth           (Q, R)
    exclude_frames  smallest number of frames that covers all excluded pairs (SeqSLAM needs frames, not seconds)
    wide            the truth (Q, R) by poses with an angle of 45 degrees; None without poses, or if truth has more
    notes           remarks for readers of the results: what was left out, what looks wrong
    """

    name: str
    queries: ImageSequence
    references: ImageSequence | None
    truth: Truth
    exclude_frames: int = 0
    wide: Truth | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def database(self) -> ImageSequence:
        """The frames that are searched: the references, or the queries themselves for one sequence."""
        return self.queries if self.references is None else self.references

    @property
    def positions(self) -> np.ndarray | None:
        """The positions of the queries (Q, 3) in meters; None if any of them is not known."""
        poses = self.queries.poses
        return None if poses is None or np.isnan(poses[:, 0]).any() else poses[:, :3]


def load_sequence(
    sequence: ImageSequence,
    selection: Selection = ALL_FRAMES,
    exclusion: Exclusion | None = None,
    *,
    max_distance_m: float = MAX_DISTANCE_M,
    max_angle_deg: float = MAX_ANGLE_DEG,
    references: ImageSequence | None = None,
) -> DataSet:
    """Make a data set of a sequence with poses; truth by the paper's rule.

    ``selection`` counts all frames; then frames without a pose are left out. The default ``exclusion`` is pairs of
    frames within 10 s, or within 10 frames if there are no stamps.

    max_distance_m, max_angle_deg  see :func:`~loopclosure.places.same_place.same_place`
    references  another sequence, with poses in the same frame of reference: each query against all its frames;
                ``selection`` applies to the queries only, and no pair is excluded
    """
    taken = sequence.taken(selection)
    queries = taken.with_poses().with_files()
    others = queries if references is None else references.with_poses().with_files()
    stamps = queries.stamps
    if references is None:
        exclusion = exclusion or (FOLDER_EXCLUSION if stamps is None else TUM_EXCLUSION)
        frames = exclusion.frames if stamps is None else _excluded_frames(exclusion, stamps)
        name, notes = f"{queries.name}{_selection_text(selection)}", _pose_notes(taken)
    else:
        frames = 0
        name = f"{queries.name}{_selection_text(selection)} in {others.name}"
        notes = [*_pose_notes(taken), *(f"{others.name}: {note}" for note in _pose_notes(references))]

    def by_angle(angle_deg: float) -> Truth:
        hard = same_place_matrix(queries.known_poses(), others.known_poses(), max_distance_m, angle_deg)
        rule = f"same place: nearer than {max_distance_m:g} m and turned less than {angle_deg:g} degrees"
        if references is None:
            return sequence_truth(hard, exclusion or FOLDER_EXCLUSION, rule, stamps=stamps)
        return traverse_truth(hard, rule)

    truth = by_angle(max_angle_deg)
    wide = by_angle(WIDE_ANGLE_DEG) if max_angle_deg < WIDE_ANGLE_DEG else None
    data = DataSet(name, queries, None if references is None else others, truth, frames, wide, notes)
    return _checked(data, truth.hard)


def _pose_notes(sequence: ImageSequence) -> list[str]:
    """Return notes about frames without a pose, and about what looks wrong in the poses."""
    without = int(np.count_nonzero(~sequence.known))
    return [*([f"frames without a pose, left out: {without}"] if without else []), *sequence.doubts]


def load_fabmap(
    folder: str | Path,
    camera: str = "both",
    selection: Selection = ALL_FRAMES,
    exclusion: Exclusion = FABMAP_EXCLUSION,
    *,
    truth_file: str | Path | None = None,
    coordinates: str | Path | None = None,
) -> DataSet:
    """Load a set in the format of FAB-MAP's New College and City Centre: numbered images of two cameras.

    Image 0001 is the left one of the first place, 0002 the right one, and so on. The mask (``*GroundTruth.mat``) and
    the coordinates (``*Coordinates.mat`` or ``.txt``) are searched for in the folder unless they are given.

    camera     which images are used: see loopclosure.places.masks
    selection  counts images of one camera, or with "both" of both
    """
    folder = Path(folder)
    images = image_paths(folder)
    truth_path = Path(truth_file) if truth_file else _only_file(folder, ("*GroundTruth.mat",), "the mask of loops")
    assert truth_path is not None
    hard, soft, notes = _fold(truth_path, *read_truth_matrix(truth_path))
    places = images_of_places(camera, len(images))
    hard, soft = (mask_of_places(camera, matrix, len(images), truth_path) for matrix in (hard, soft))
    taken = selection.numbers(len(places))
    hard, soft, places = hard[np.ix_(taken, taken)], soft[np.ix_(taken, taken)], places[taken]
    judged = comparable(camera, places)
    if camera == "both":
        notes.append("pairs of a left and a right image are not judged: the two cameras look to opposite sides")
    sequence = ImageSequence.of_files([images[place] for place in places])
    queries = replace(sequence, poses=_fabmap_poses(folder, coordinates, len(images), places))
    rule = f"same place: as {truth_path.name} says"
    truth = sequence_truth(hard, exclusion, rule, soft=soft, comparable=judged)
    views = "left and right images" if camera == "both" else f"{camera} images"
    name = f"{folder.resolve().name}, {views}{_selection_text(selection)}"
    data = DataSet(name, queries, None, truth, exclusion.frames, notes=notes)
    return _checked(data, hard & judged)


def load_folder(
    images: str | Path,
    truth_file: str | Path,
    selection: Selection = ALL_FRAMES,
    exclusion: Exclusion = FOLDER_EXCLUSION,
) -> DataSet:
    """Load the images of one sequence and their mask (N, N)."""
    queries = ImageSequence.of_files(image_paths(images))
    hard, soft = read_truth_matrix(truth_file)
    name = f"{_folder_name(images)}{_selection_text(selection)}"
    rule = f"same place: as {Path(truth_file).name} says"
    hard, soft, notes = _fold(Path(truth_file), hard, soft)
    if len(hard) != len(queries):
        raise InputError(f"is {len(hard)} x {len(hard)}, but there are {len(queries)} images in {images}", truth_file)
    taken = selection.numbers(len(queries))
    hard, soft = hard[np.ix_(taken, taken)], soft[np.ix_(taken, taken)]
    truth = sequence_truth(hard, exclusion, rule, soft=soft, stamps=None)
    data = DataSet(name, queries.at(taken), None, truth, exclusion.frames, notes=notes)
    return _checked(data, hard)


def load_traverses(
    queries: str | Path,
    references: str | Path,
    tolerance: int = 0,
    selection: Selection = ALL_FRAMES,
    truth_file: str | Path | None = None,
) -> DataSet:
    """Load two traverses of one route.

    Without ``truth_file``, frames with the same number show the same place, as in Nordland. Frames i and j are the same
    place if |i - j| <= ``tolerance``, which counts all frames; ``selection`` then takes the same frames of both
    traverses. With ``truth_file`` (a mask or lists, see :func:`loopclosure.places.masks.read_matches`), ``selection``
    applies to the queries only.
    """
    query_images = ImageSequence.of_files(image_paths(queries))
    reference_images = ImageSequence.of_files(image_paths(references))
    name = f"{_folder_name(queries)} in {_folder_name(references)}{_selection_text(selection)}"
    if truth_file is not None:
        if tolerance:
            raise InputError("a tolerance cannot be used with a file of matching frames", truth_file)
        hard, soft = read_matches(truth_file, len(query_images), len(reference_images))
        taken = selection.numbers(len(query_images))
        truth = traverse_truth(hard[taken], f"same place: as {Path(truth_file).name} says", soft=soft[taken])
        return _checked(DataSet(name, query_images.at(taken), reference_images, truth), truth.hard)
    if len(query_images) != len(reference_images):
        raise InputError(
            f"{len(query_images)} queries in {queries}, {len(reference_images)} references in {references}; "
            "expected equal numbers, since frame i of one is frame i of the other"
        )
    if tolerance < 0:
        raise InputError(f"tolerance is {tolerance}; expected 0 or more")
    taken = selection.numbers(len(query_images))
    differences = np.abs(np.subtract.outer(taken, taken))
    rule = f"same place: at most {tolerance} frames apart" if tolerance else "same place: the frame of the same number"
    truth = traverse_truth(differences <= tolerance, rule)
    return DataSet(name, query_images.at(taken), reference_images.at(taken), truth)


def load_place_pairs(folder: str | Path, selection: Selection = ALL_FRAMES) -> DataSet:
    """Load places photographed twice: a folder with pairs.csv (place_id, query, ref); each query against all refs."""
    folder = Path(folder)
    rows = read_place_pairs(folder / "pairs.csv")
    rows = [rows[i] for i in selection.numbers(len(rows))]
    places = np.array([place for place, _, _ in rows])
    truth = traverse_truth(places[:, None] == places[None, :], "same place: the same place_id in pairs.csv")
    name = f"{folder.resolve().name}{_selection_text(selection)}"
    queries = ImageSequence.of_files([query for _, query, _ in rows])
    references = ImageSequence.of_files([reference for _, _, reference in rows])
    return DataSet(name, queries, references, truth)


def _fold(path: Path, hard: np.ndarray, soft: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Move a square mask below the diagonal (frame i against earlier frames); return it with notes about it."""
    if hard.shape[0] != hard.shape[1]:
        raise InputError(f"is {hard.shape[0]} x {hard.shape[1]}; the mask of one sequence is square", path)
    above = int(np.count_nonzero(np.triu(hard, 1)))
    notes = []
    if above and not np.array_equal(hard, hard.T):
        notes.append(f"{path.name}: {above} entries above the diagonal were taken as loops of the later frame")
    return np.tril(hard | hard.T, -1), np.tril(soft | soft.T, -1), notes


def _fabmap_poses(
    folder: Path, coordinates_file: str | Path | None, images: int, places: np.ndarray
) -> np.ndarray | None:
    """Return poses (N, 7) with x and y from a file of coordinates, the rest NaN; None if there is no file."""
    path = Path(coordinates_file) if coordinates_file else _only_file(folder, ("*Coordinates.mat", "*Coordinates.txt"))
    if path is None:
        return None
    coordinates = read_coordinates(path)
    if len(coordinates) not in (images, images / 2):
        raise InputError(f"has {len(coordinates)} rows, but there are {images} images", path)
    poses = np.full((len(places), 7), np.nan)
    poses[:, : coordinates.shape[1]] = coordinates[places * len(coordinates) // images]
    return poses


def _only_file(folder: Path, patterns: Sequence[str], needed: str = "") -> Path | None:
    """Return the first file of the folder that matches a pattern, or None; InputError if it is ``needed``."""
    for pattern in patterns:
        found = sorted(folder.glob(pattern))
        if found:
            return found[0]
    if needed:
        raise InputError(f"has no {' or '.join(patterns)}, {needed}; give the file", folder)
    return None


def _folder_name(source: str | Path) -> str:
    """Return the name of a folder, with its parent if many data sets have a folder of that name."""
    path = Path(source).resolve()
    return f"{path.parent.name}/{path.name}" if path.name.lower() in COMMON_NAMES else path.name


def _excluded_frames(exclusion: Exclusion, stamps: np.ndarray) -> int:
    """Return the smallest number of frames that covers the exclusion, including its seconds."""
    earliest = np.searchsorted(stamps, stamps - exclusion.seconds, side="right")
    return max(exclusion.frames, int(np.max(np.arange(len(stamps)) - earliest)))


def _selection_text(selection: Selection) -> str:
    parts = []
    if selection.start not in (0, "0", "0%") or selection.stop is not None:
        parts.append(f"frames {selection.start} to {'the last' if selection.stop is None else selection.stop}")
    if selection.stride > 1:
        parts.append(f"every {selection.stride}{ {2: 'nd', 3: 'rd'}.get(selection.stride, 'th') }")
    if selection.limit is not None:
        parts.append(f"at most {selection.limit}")
    return f" ({', '.join(parts)})" if parts else ""


def _checked(data: DataSet, hard: np.ndarray) -> DataSet:
    """Note how many loops the exclusion removes. Raises InputError if no loop is left."""
    if data.references is None:
        whole = int(np.count_nonzero(np.tril(hard, -1)))
        lost = whole - data.truth.positives
        if lost:
            data.notes.append(f"{lost} of {whole} pairs that show the same place are excluded as too near in time")
    if not data.truth.positives:
        raise InputError(
            f"{data.name}: no judged pair shows the same place ({data.truth.description}); nothing can be found"
        )
    return data

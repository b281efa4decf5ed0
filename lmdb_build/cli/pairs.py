"""``lmdb-build pairs`` and ``sheet``: lists of labeled pairs."""

from __future__ import annotations

import argparse
import itertools
import os
from pathlib import Path

from lmdb_build.pairs.build import Plan, build_lists
from lmdb_build.pairs.by_list import MaskSource, TraverseSource, folders_source
from lmdb_build.pairs.by_pose import NEGATIVES, PoseRule, PoseSource, Scenes
from lmdb_build.pairs.choose import SPLITS, PairSource
from lmdb_build.pairs.list_file import root_of, write_contact_sheet
from loopclosure.errors import InputError
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.masks import CAMERAS
from loopclosure.places.same_place import MAX_ANGLE_DEG, MAX_DISTANCE_M
from loopclosure.places.source import (
    LAYOUT_LINES,
    LAYOUTS,
    PAIRED,
    POSE_FORM_HELP,
    POSES_HELP,
    Source,
    is_recording,
    open_sequence,
    read_source,
    resolved,
)
from loopclosure.places.trajectory import MAX_DIFFERENCE_S
from netspec.files.paths import relative
from netspec.terminal.commands import WrongUsage, refuse
from netspec.terminal.output import bar, warn
from netspec.terminal.parser import Commands, above_zero, seed

SEQUENCES = ("", *LAYOUTS)
HELP = f"""A SOURCE is [KIND:]PATH[,KEY=VALUE]...

One or more sequences with poses (KIND may be omitted; it is then detected from the files):
{LAYOUT_LINES}
  with poses=FILE, {POSES_HELP},
  and pose-form: {POSE_FORM_HELP}; topic, pose-topic: the topics to read from a bag with several
Or one source of another kind:
  images:     images in natural order, truth=MASK of loops (.mat .npy .txt or image), camera={"|".join(CAMERAS)}
  traverses:  queries, references=FOLDER, truth=MASK or ground_truth*.json
  nordland:   query/, ref/, ground_truth*.json, as in VPR benchmarks
  folders:    a folder, references=FOLDER; files with equal names show the same place"""
# Options for sequences with poses only.
POSED = (
    "max_distance",
    "max_angle",
    "negatives",
    "clear_distance",
    "clear_view_angle",
    "same_scene",
    "same_frame",
    "different_scenes",
    "max_difference",
)


def add_commands(commands: Commands) -> None:
    """Add the commands of this module."""
    _add_pairs(commands)
    _add_sheet(commands)


def _add_pairs(commands: Commands) -> None:
    parser = commands.add_parser(
        "pairs",
        _pairs,
        help="choose labeled pairs and write their lists",
        epilog=HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "source",
        nargs="+",
        type=_source_text,
        metavar="SOURCE",
        help="sequences with poses, or one source of another kind (see below)",
    )
    parser.add_output(
        "--out",
        folder=True,
        type=Path,
        required=True,
        metavar="FOLDER",
        help="folder for train.txt, val.txt and test.txt",
    )
    parser.add_argument(
        "--root",
        type=Path,
        metavar="FOLDER",
        help="folder that the image names are relative to (default: the common parent of the sources)",
    )
    group = parser.add_argument_group("rules for the same place")
    group.add_argument(
        "--max-distance",
        type=above_zero,
        default=MAX_DISTANCE_M,
        metavar="M",
        help=f"maximum distance between the images of a positive pair (default: {MAX_DISTANCE_M:g})",
    )
    group.add_argument(
        "--max-angle",
        type=above_zero,
        default=MAX_ANGLE_DEG,
        metavar="DEG",
        help=f"maximum angle between the images of a positive pair (default: {MAX_ANGLE_DEG:g})",
    )
    group.add_argument(
        "--min-gap",
        type=float,
        metavar="S",
        help="minimum time between the images of a pair, in seconds (images: in frames; default: 0)",
    )
    group.add_argument(
        "--negatives", default="both", choices=NEGATIVES, help="where negatives come from (default: %(default)s)"
    )
    group.add_argument(
        "--clear-distance",
        type=float,
        metavar="M",
        help="minimum distance between the poses of a negative pair",
    )
    group.add_argument(
        "--clear-view-angle", type=float, metavar="DEG", help="or minimum angle between its viewing directions"
    )
    group.add_argument(
        "--same-scene",
        action="append",
        type=_names,
        default=[],
        metavar="A,B",
        help="sequences of the same scene: form no pairs across them",
    )
    group.add_argument(
        "--same-frame",
        action="append",
        type=_names,
        default=[],
        metavar="A,B",
        help="sequences with the same coordinate frame: label pairs across them by pose",
    )
    group.add_argument("--different-scenes", action="store_true", help="all other sequences show different scenes")
    group.add_argument(
        "--max-difference",
        type=float,
        default=MAX_DIFFERENCE_S,
        metavar="S",
        help=f"maximum time between an image and its pose (default: {MAX_DIFFERENCE_S:g})",
    )
    group = parser.add_argument_group("choice of the pairs")
    for split, count in zip(SPLITS, (30000, 6000, 6000), strict=True):
        group.add_argument(
            f"--{split}",
            type=int,
            default=count,
            metavar="N",
            help="number of pairs, half of them positive (default: %(default)s)",
        )
    group.add_argument("--at-most", action="store_true", help="accept fewer pairs if there are not enough")
    group.add_argument(
        "--split", choices=("time", "sequence"), help="split by time, or by whole sequences (or places, or groups)"
    )
    group.add_argument(
        "--shares",
        type=_shares,
        default=(0.6, 0.2, 0.2),
        metavar="A,B,C",
        help="shares of the images in train, val and test (default: 0.6,0.2,0.2)",
    )
    group.add_argument(
        "--split-gap",
        type=float,
        default=0.0,
        metavar="S",
        help="time to leave out between two splits (default: %(default)g)",
    )
    for split in SPLITS:
        group.add_argument(f"--{split}-sequences", type=_names, metavar="A,B", help=f"sequences (or groups) of {split}")
    group.add_argument("--seed", type=seed, default=1, metavar="N", help="random seed (default: %(default)s)")


def _pairs(arguments: argparse.Namespace) -> None:
    named = {split: names for split in SPLITS if (names := getattr(arguments, f"{split}_sequences"))}
    source, root = _source(arguments)
    in_time = isinstance(source, (PoseSource, MaskSource))
    by = arguments.split or ("sequence" if named or not in_time else "time")
    if named and by == "time":
        raise WrongUsage("--train-sequences, --val-sequences and --test-sequences need --split sequence")
    plan = Plan(
        counts={split: getattr(arguments, split) for split in SPLITS},
        seed=arguments.seed,
        by="time" if by == "time" else "group",
        shares=dict(zip(SPLITS, arguments.shares, strict=True)),
        split_gap=arguments.split_gap,
        named=named,
        at_most=arguments.at_most,
    )
    lists = build_lists(source, plan, root, arguments.out)
    for written in lists.values():
        print(written.report)
        for doubt in written.doubts:
            warn(doubt)
    paths = ", ".join(str(written.path) for written in lists.values())
    print(f"wrote {paths}; their image names are relative to {root}/")


def _source_text(text: str) -> Source:
    try:
        return resolved(read_source(text, PAIRED))
    except InputError as fault:
        raise argparse.ArgumentTypeError(str(fault)) from None


def _source(arguments: argparse.Namespace) -> tuple[PairSource, Path]:
    """Open the sources; return one combined source, and the root folder."""
    first, *others = arguments.source
    path, kind = first.path, first.kind
    if (kind not in SEQUENCES and others) or any(each.kind not in SEQUENCES for each in others):
        raise WrongUsage(
            f"{kind or 'sequences'}: several sources must all be sequences; give one source of another kind"
        )
    if kind not in SEQUENCES:
        refuse(arguments, POSED, f"is for sequences with poses, not for {kind}")
    sequences = _sequences(arguments) if kind in SEQUENCES else []
    places = [sequence.source.resolve().parent for sequence in sequences]
    if kind not in SEQUENCES:
        places = [path, *(other for other in (first.get("references", Path),) if other)]
    root = arguments.root or Path(relative(os.path.commonpath([place.resolve() for place in places])))
    if sequences:
        return _pose_source(arguments, sequences, root), root
    min_gap = None if arguments.min_gap is None else int(arguments.min_gap)
    truth, references = first.get("truth", Path), first.get("references", Path)
    if kind == "traverses":
        if truth is None or references is None:
            raise WrongUsage(f"traverses:{first} needs ,truth=FILE (which images show the same place)")
        return TraverseSource(truth, path, references, root), root
    if kind == "images":
        assert truth is not None
        return MaskSource(truth, path, root, min_gap, first.get("camera", str) or "all"), root
    assert references is not None
    return folders_source(path, references, root, min_gap or 0), root


def _sequences(arguments: argparse.Namespace) -> list[ImageSequence]:
    """Read the sequences; the frames of bags and videos are extracted to a folder of each below --out."""
    found, taken = [], set[str]()
    for source in arguments.source:
        name = next(n for k in itertools.count(1) if (n := f"{source.path.stem}_{k}".removesuffix("_1")) not in taken)
        if is_recording(source.path):
            taken.add(name)
        sequence, said = open_sequence(
            source,
            arguments.out / name,
            posed=True,
            videos=True,
            max_difference=arguments.max_difference,
            progress=bar,
        )
        if said:
            print(said)
        found.append(sequence)
    return found


def _pose_source(arguments: argparse.Namespace, opened: list[ImageSequence], root: Path) -> PoseSource:
    sequences = []
    for every in opened:
        sequence = every.with_poses()
        left_out = len(every) - len(sequence)
        print(f"{every.source}: {len(sequence)} images with a pose, {left_out} without one left out")
        for doubt in sequence.doubts:
            warn(doubt)
        sequences.append(sequence)
    rule = PoseRule(
        max_distance_m=arguments.max_distance,
        max_angle_deg=arguments.max_angle,
        min_gap_s=arguments.min_gap or 0.0,
        negatives=arguments.negatives,
        clear_distance_m=arguments.clear_distance,
        clear_view_angle_deg=arguments.clear_view_angle,
    )
    scenes = Scenes(tuple(arguments.same_scene), tuple(arguments.same_frame), arguments.different_scenes)
    folders = [relative(every.source.resolve(), root.resolve()) for every in opened]
    return PoseSource(sequences, folders, rule, scenes)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name for name in text.split(",") if name)


def _shares(text: str) -> tuple[float, ...]:
    parts = text.split(",")
    try:
        shares = tuple(float(part) for part in parts)
    except ValueError:
        shares = ()
    if len(shares) != len(SPLITS):
        raise argparse.ArgumentTypeError(f'expected three numbers for {", ".join(SPLITS)}, found "{text}"')
    return shares


def _add_sheet(commands: Commands) -> None:
    parser = commands.add_parser("sheet", _sheet, help="draw sample pairs of a list")
    parser.add_argument("list", type=Path, metavar="LIST", help="a list of pairs")
    parser.add_output("picture", type=Path, metavar="PICTURE", help="the image to write, such as sheet.png")
    parser.add_argument(
        "--root", type=Path, metavar="FOLDER", help="folder of the images (default: the folder in the list's header)"
    )
    parser.add_argument(
        "--rows", type=int, default=6, metavar="N", help="number of pairs of each label (default: %(default)s)"
    )
    parser.add_argument("--seed", type=seed, default=1, metavar="N", help="random seed (default: %(default)s)")


def _sheet(arguments: argparse.Namespace) -> None:
    root = arguments.root or root_of(arguments.list)
    write_contact_sheet(arguments.list, root, arguments.picture, arguments.rows, arguments.seed)
    print(arguments.picture)

"""The command ``lmdb-build``: walks, pairs of images, views in batches, contact sheets."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2

from lmdb_build.bar import bar
from lmdb_build.pairs.build import Plan, build_lists
from lmdb_build.pairs.by_list import (
    CAMERAS,
    MaskSource,
    folders_source,
    index_source,
    singles_source,
    table_source,
)
from lmdb_build.pairs.by_pose import NEGATIVES, PoseRule, PoseSource, Scenes
from lmdb_build.pairs.choose import SPLITS, PairSource
from lmdb_build.pairs.contact_sheet import write_contact_sheet
from lmdb_build.pairs.list_file import join_lists, root_of
from lmdb_build.pairs.runs import folder_runs, index_runs
from lmdb_build.views import Batches, write_views
from lmdb_build.walk.sequence import Walk, write_walk
from loopclosure.descriptors.feature_file import read_features
from loopclosure.errors import InputError
from loopclosure.places.same_place import MAX_ANGLE_DEG, MAX_DISTANCE_M
from loopclosure.places.trajectory import MAX_DIFFERENCE_S, read_tum_sequence

PROGRAM = "lmdb-build"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status: 0 done, 1 a fault of the user's files, 2 wrong usage."""
    parser = _parser()
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)  # the pictures are small
    try:
        options.run(options, parser)
    except InputError as error:
        print(error, file=sys.stderr)
        return 1
    except OSError as error:
        print(f"{error.filename}: {error.strerror}" if error.filename else error, file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM, description="From image sequences to labelled pairs (then: tools/convert_pairs_lmdb)."
    )
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    _add_walk(commands.add_parser("walk", help="render a made-up walk through textured rooms, as TUM RGB-D sequences"))
    _add_pairs(commands.add_parser("pairs", help="choose labelled pairs and write their lists"))
    _add_views(commands.add_parser("views", help="make two views of each place, in batches of different places"))
    _add_sheet(commands.add_parser("sheet", help="draw sample pairs of a list as a picture"))
    _add_join(commands.add_parser("join", help="shuffle several lists into one"))
    return parser


def _add_walk(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", type=Path, metavar="OUT", help="folder for the sequences walk_1, walk_2, ...")
    parser.add_argument("--sequences", type=int, default=1, help="how many, each in a house of its own (1)")
    parser.add_argument("--frames", type=int, default=400, help="images a sequence (400)")
    parser.add_argument("--size", type=_size, default=(320, 240), help="of an image (320x240)")
    parser.add_argument("--laps", type=int, default=3, help="rounds of the house (3)")
    parser.add_argument("--rooms", type=int, default=4, help="of a house; an even number (4)")
    parser.add_argument("--seed", type=int, default=1, help="another seed, other houses (1)")
    parser.set_defaults(run=_walk)


def _walk(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    if options.seed < 0:
        parser.error("--seed must be 0 or more")
    if not 1 <= options.sequences <= 999:
        parser.error("--sequences must be 1 to 999")
    for number in range(1, options.sequences + 1):
        walk = Walk(
            frames=options.frames,
            width=options.size[0],
            height=options.size[1],
            laps=options.laps,
            rooms=options.rooms,
            seed=1000 * options.seed + number,
            start_s=10_000.0 * number,
        )
        folder = options.out / f"walk_{number}"
        for _ in bar(write_walk(folder, walk), folder.name, walk.frames):
            pass
        print(f"{folder}: {walk.frames} images, {walk.laps} laps of {walk.rooms} rooms")


def _add_pairs(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("sequences", type=Path, nargs="*", metavar="SEQUENCE", help="folders in TUM RGB-D layout: pairs by pose")
    add("--out", type=Path, required=True, help="folder for train.txt, val.txt and test.txt")
    add("--root", type=Path, help="folder that the lists' names are relative to (the sources' common parent)")

    source = parser.add_argument_group("other sources, instead of sequences")
    source.add_argument(
        "--mask", type=Path, metavar="FILE", help="a mask of loops (.mat, .npy, .txt, image) of --images"
    )
    source.add_argument("--images", type=Path, metavar="FOLDER", help="the images of --mask, in natural order")
    source.add_argument(
        "--camera", choices=CAMERAS, default="all", help="FAB-MAP's sets alternate left and right (all)"
    )
    source.add_argument("--folders", type=Path, nargs=2, metavar="FOLDER", help="equal names are the same place")
    source.add_argument("--table", type=Path, metavar="CSV", help="positives: two columns of image names")
    source.add_argument("--index", type=Path, metavar="CSV", help="a table of frames; with --table, of their groups")
    source.add_argument(
        "--group", metavar="COLUMN", help="different values are other places: negatives come from there"
    )
    source.add_argument("--track", metavar="COLUMN", help="of --index: frames of one clip")
    source.add_argument("--time", metavar="COLUMN", help="of --index: where in the clip; neighbours are positives")
    source.add_argument("--max-gap", type=float, default=1.0, help="how far apart such neighbours may be (1)")
    source.add_argument(
        "--singles", type=Path, metavar="FOLDER", help="each image is a place of its own: all is warped"
    )

    rule = parser.add_argument_group("what is the same place")
    rule.add_argument("--max-distance", type=float, default=MAX_DISTANCE_M, help="metres; nearer is a positive (2)")
    rule.add_argument("--max-angle", type=float, default=MAX_ANGLE_DEG, help="degrees; less turned is a positive (15)")
    rule.add_argument("--min-gap", type=float, help="pairs nearer in time are left out: seconds, of a mask images (0)")
    rule.add_argument("--negatives", choices=NEGATIVES, default="both", help="where negatives come from (both)")
    rule.add_argument("--clear-distance", type=float, metavar="M", help="negatives by pose only from so far apart")
    rule.add_argument("--clear-view-angle", type=float, metavar="DEG", help="or from viewing axes so far turned")
    sets = {"type": _names, "action": "append", "default": [], "metavar": "A,B"}
    rule.add_argument("--same-scene", **sets, help="sequences of one room: no pair is made across them")
    rule.add_argument("--same-frame", **sets, help="sequences whose poses share a frame: judged by pose across them")
    rule.add_argument("--different-scenes", action="store_true", help="all sequences else show different rooms")
    rule.add_argument("--max-difference", type=float, default=MAX_DIFFERENCE_S, help="image to pose, seconds (0.03)")

    choice = parser.add_argument_group("the choice")
    for split, number in zip(SPLITS, (30000, 6000, 6000), strict=True):
        choice.add_argument(
            f"--{split}", type=int, default=number, metavar="N", help=f"pairs, half positive ({number})"
        )
    choice.add_argument("--at-most", action="store_true", help="fewer pairs where there are not enough")
    choice.add_argument("--split", choices=("time", "sequence"), help="whole sequences (places, groups) or stretches")
    choice.add_argument("--shares", type=_shares, default=(0.6, 0.2, 0.2), help="of the images (0.6,0.2,0.2)")
    choice.add_argument("--split-gap", type=float, default=0.0, help="seconds left out between two splits (0)")
    for split in SPLITS:
        choice.add_argument(f"--{split}-sequences", type=_names, metavar="A,B", help=f"sequences (groups) of {split}")
    choice.add_argument("--hard-negatives", type=Path, metavar="NPZ", help="nearest negatives by a net's features")
    choice.add_argument("--hard-share", type=float, default=0.5, help="of the negatives (0.5)")
    choice.add_argument("--warp-share", type=float, default=0.0, help="of the pairs: one image is a warped copy (0)")
    choice.add_argument("--seed", type=int, default=1, help="another seed, other pairs (1)")
    parser.set_defaults(run=_pairs)


def _pairs(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    named = {split: names for split in SPLITS if (names := getattr(options, f"{split}_sequences"))}
    source, root = _source(options, parser)
    by_pose = bool(options.sequences or options.mask)
    by = options.split or ("sequence" if named or not by_pose else "time")
    if named and by == "time":
        parser.error("--train-sequences, --val-sequences and --test-sequences need --split sequence")
    plan = Plan(
        counts={split: getattr(options, split) for split in SPLITS},
        seed=options.seed,
        by="time" if by == "time" else "group",
        shares=dict(zip(SPLITS, options.shares, strict=True)),
        split_gap=options.split_gap,
        named=named,
        at_most=options.at_most,
        features=read_features(options.hard_negatives) if options.hard_negatives else None,
        hard_share=options.hard_share,
        warp_share=1.0 if options.singles else options.warp_share,
    )
    lists = build_lists(source, plan, root, options.out, print, _warn, bar)
    for split, path in lists.items():
        print(f"tools/convert_pairs_lmdb {root}/ {path} {options.out / split}_lmdb")


def _source(options: argparse.Namespace, parser: argparse.ArgumentParser) -> tuple[PairSource, Path]:
    """Open the one source that is named; return it and the root folder."""
    kinds = ("sequences", "mask", "folders", "table", "singles")
    given = [kind for kind in kinds if getattr(options, kind)]
    if options.index and "table" not in given:
        given.append("index")
    if len(given) != 1:
        parser.error("name sequences or one of --mask, --folders, --table, --index, --singles")
    kind = given[0]
    if kind == "mask" and not options.images:
        parser.error("--mask needs --images")
    if kind == "index" and not (options.group and options.track and options.time):
        parser.error("--index without --table needs --group, --track and --time")
    places = {
        "sequences": [folder.resolve().parent for folder in options.sequences],
        "mask": [options.images],
        "folders": options.folders,
        "table": [options.table.parent] if options.table else [],
        "index": [options.index.parent] if options.index else [],
        "singles": [options.singles],
    }[kind]
    warped = [options.out] if options.warp_share or options.singles else []
    root = options.root or Path(os.path.relpath(os.path.commonpath([str(p.resolve()) for p in [*places, *warped]])))
    if kind == "sequences":
        return _pose_source(options, root), root
    min_gap = None if options.min_gap is None else int(options.min_gap)
    if kind == "mask":
        return MaskSource(options.mask, options.images, root, min_gap, options.camera), root
    if kind == "folders":
        return folders_source(options.folders[0], options.folders[1], root, min_gap or 0), root
    if kind == "table":
        return table_source(options.table, root, options.group, options.index), root
    if kind == "index":
        return index_source(options.index, root, options.group, options.track, options.time, options.max_gap), root
    return singles_source(options.singles, root), root


def _pose_source(options: argparse.Namespace, root: Path) -> PoseSource:
    sequences = [read_tum_sequence(folder, options.max_difference) for folder in options.sequences]
    for folder, sequence in zip(options.sequences, sequences, strict=True):
        print(f"{folder}: {len(sequence)} images with a pose, {sequence.dropped} without one left out")
    rule = PoseRule(
        max_distance_m=options.max_distance,
        max_angle_deg=options.max_angle,
        min_gap_s=options.min_gap or 0.0,
        negatives=options.negatives,
        clear_distance_m=options.clear_distance,
        clear_view_angle_deg=options.clear_view_angle,
    )
    scenes = Scenes(tuple(options.same_scene), tuple(options.same_frame), options.different_scenes)
    folders = [Path(os.path.relpath(folder.resolve(), root.resolve())).as_posix() for folder in options.sequences]
    return PoseSource(sequences, folders, rule, scenes)


def _add_views(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("folders", type=Path, nargs="*", metavar="FOLDER", help="runs of images, or give --index")
    add("--out", type=Path, required=True, help="folder for the views; the list is OUT.txt")
    add("--index", type=Path, metavar="CSV", help="a table of frames, with --track and --time")
    add("--track", metavar="COLUMN", help="of --index: frames of one run")
    add("--time", metavar="COLUMN", help="of --index: where in the run")
    add("--batches", type=int, default=400, help="how many batches (400)")
    add("--size", type=int, default=48, help="pairs a batch, each of another place (48)")
    add("--per-track", type=int, default=8, help="of them at most so many of one run (8)")
    add("--apart", type=float, default=4.0, help="places of one run are further apart: seconds, or images (4)")
    add("--max-gap", type=float, default=1.0, help="two views may be of two images so far apart (1)")
    add("--other", type=float, default=0.4, help="in this share of the pairs they are (0.4)")
    add("--negatives", type=float, default=0.0, help="share of pairs of two places, for ContrastiveLoss (0)")
    add("--view-size", type=_size, default=(128, 96), help="of a view (128x96)")
    add("--seed", type=int, default=1, help="another seed, other views (1)")
    parser.set_defaults(run=_views)


def _views(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    if bool(options.folders) == bool(options.index):
        parser.error("name folders, or --index")
    if options.index:
        if not (options.track and options.time):
            parser.error("--index needs --track and --time")
        root = options.index.parent
        runs = index_runs(options.index, root, options.track, options.time)
    else:
        root = Path(os.path.commonpath([folder.resolve() for folder in options.folders]))
        runs = folder_runs(options.folders, root)
    batches = Batches(options.batches, options.size, options.per_track, options.apart, options.max_gap, options.other)
    path = write_views(runs, batches, options.view_size, root, options.out, options.seed, bar)
    print(f"{path}: {options.batches} batches of {options.size} pairs")
    print(f"tools/convert_pairs_lmdb {path.parent}/ {path} {options.out}_lmdb")


def _add_sheet(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("list", type=Path, metavar="LIST", help="a list of pairs")
    parser.add_argument("out", type=Path, metavar="PICTURE", help="the picture to write, such as sheet.png")
    parser.add_argument("--root", type=Path, help="folder of the images (what the list's head says)")
    parser.add_argument("--rows", type=int, default=6, help="pairs of each label (6)")
    parser.add_argument("--seed", type=int, default=1, help="another seed, other pairs (1)")
    parser.set_defaults(run=_sheet)


def _sheet(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    root = options.root or root_of(options.list)
    write_contact_sheet(options.list, root, options.out, options.rows, options.seed)
    print(options.out)


def _add_join(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", type=Path, metavar="OUT", help="the list to write")
    parser.add_argument("lists", type=Path, nargs="+", metavar="LIST", help="lists of pairs")
    parser.add_argument("--root", type=Path, help="folder that the names are relative to (the lists' roots' parent)")
    parser.add_argument("--seed", type=int, default=1, help="another seed, another order (1)")
    parser.set_defaults(run=_join)


def _join(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    number, root = join_lists(options.lists, options.out, options.seed, options.root)
    print(f"{options.out}: {number} pairs, images below {root}")


def _warn(doubt: str) -> None:
    print(f"warning: {doubt}", file=sys.stderr)


def _size(text: str) -> tuple[int, int]:
    width, cross, height = text.partition("x")
    if not (cross and width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f'expected WIDTHxHEIGHT such as 320x240, found "{text}"')
    return int(width), int(height)


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

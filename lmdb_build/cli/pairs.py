"""``lmdb-build pairs``."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from lmdb_build.cli.bar import bar
from lmdb_build.pairs.build import Plan, build_lists
from lmdb_build.pairs.by_list import (
    CAMERAS,
    MaskSource,
    TraverseSource,
    folders_source,
    index_source,
    singles_source,
    table_source,
)
from lmdb_build.pairs.by_pose import NEGATIVES, PoseRule, PoseSource, Scenes
from lmdb_build.pairs.choose import SPLITS, PairSource
from loopclosure.descriptors.feature_file import read_features
from loopclosure.places.extraction import LAYOUTS, POSE_FORM_HELP, POSES_HELP, RECORDED, extract, is_recording
from loopclosure.places.pose_files import pose_form
from loopclosure.places.same_place import MAX_ANGLE_DEG, MAX_DISTANCE_M
from loopclosure.places.sequences import PoseChoice, benchmark_parts, layout_of, read_posed
from loopclosure.places.trajectory import MAX_DIFFERENCE_S
from netspec.terminal.commands import Commands, WrongUsage
from netspec.terminal.options import above_zero, seed


def add_to(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add("pairs", _pairs, "choose labeled pairs and write their lists")
    add = parser.add_argument
    add("sequences", type=Path, nargs="*", metavar="SEQUENCE", help=f"pairs by pose: {', '.join(LAYOUTS.values())}")
    add("--out", type=Path, required=True, help="folder for train.txt, val.txt and test.txt")
    add("--root", type=Path, help="folder that the lists' names are relative to (the sources' common parent)")

    posed = parser.add_argument_group("sequences with poses")
    for layout, what in LAYOUTS.items():
        about = f"a SEQUENCE that must be {what}; may be repeated"
        posed.add_argument(f"--{layout}", type=Path, action="append", default=[], metavar="PATH", help=about)
    posed.add_argument("--topic", default="", help="of the images of bags that have several")
    posed.add_argument("--pose-topic", default="", metavar="TOPIC", help="of the poses of bags that have several")
    posed.add_argument("--poses", type=Path, metavar="FILE", help=POSES_HELP)
    posed.add_argument("--pose-form", default="", metavar="WORDS", help=POSE_FORM_HELP)

    source = parser.add_argument_group("other sources, instead of sequences")
    source.add_argument(
        "--mask",
        type=Path,
        metavar="FILE",
        help="a mask of loops (.mat, .npy, .txt, image) of --images or --traverses; of these also ground_truth*.npy",
    )
    source.add_argument("--traverses", type=Path, nargs=2, metavar=("QUERIES", "REFERENCES"), help="with --mask")
    source.add_argument(
        "--nordland", type=Path, metavar="FOLDER", help="query/, ref/, ground_truth*.npy: VPR benchmarks"
    )
    source.add_argument("--images", type=Path, metavar="FOLDER", help="the images of --mask, in natural order")
    source.add_argument(
        "--camera",
        choices=CAMERAS,
        default="all",
        help="which images to use: FAB-MAP's data alternates left and right (all)",
    )
    source.add_argument("--folders", type=Path, nargs=2, metavar="FOLDER", help="equal names are the same place")
    source.add_argument("--table", type=Path, metavar="CSV", help="positives: two columns of image names")
    source.add_argument("--index", type=Path, metavar="CSV", help="a table of frames; with --table, of their groups")
    source.add_argument(
        "--group", metavar="COLUMN", help="column that names the place: images of different places are negatives"
    )
    source.add_argument("--track", metavar="COLUMN", help="column of --index that names the clip")
    source.add_argument(
        "--time", metavar="COLUMN", help="column of --index with the position in the clip: neighbors are positives"
    )
    source.add_argument("--max-gap", type=float, default=1.0, help="largest distance of such neighbors (1)")
    source.add_argument(
        "--singles", type=Path, metavar="FOLDER", help="each image is a different place; positives are warped copies"
    )

    rule = parser.add_argument_group("what is the same place")
    rule.add_argument("--max-distance", type=above_zero, default=MAX_DISTANCE_M, help="meters; less is a positive (2)")
    rule.add_argument("--max-angle", type=above_zero, default=MAX_ANGLE_DEG, help="degrees; less is a positive (15)")
    rule.add_argument("--min-gap", type=float, help="leave out pairs nearer in time: seconds (--mask: images) (0)")
    rule.add_argument("--negatives", choices=NEGATIVES, default="both", help="where negatives come from (both)")
    rule.add_argument("--clear-distance", type=float, metavar="M", help="negatives by pose are at least this far apart")
    rule.add_argument("--clear-view-angle", type=float, metavar="DEG", help="or their viewing axes are")
    sets = {"type": _names, "action": "append", "default": [], "metavar": "A,B"}
    rule.add_argument("--same-scene", **sets, help="sequences of one room: no pair is made across them")
    rule.add_argument("--same-frame", **sets, help="sequences whose poses share a frame: labeled by pose across them")
    rule.add_argument("--different-scenes", action="store_true", help="all other sequences show different rooms")
    rule.add_argument(
        "--max-difference", type=float, default=MAX_DIFFERENCE_S, help="longest time from image to pose, seconds (0.03)"
    )

    choice = parser.add_argument_group("the choice")
    for split, number in zip(SPLITS, (30000, 6000, 6000), strict=True):
        choice.add_argument(
            f"--{split}", type=int, default=number, metavar="N", help=f"pairs, half positive ({number})"
        )
    choice.add_argument("--at-most", action="store_true", help="take fewer pairs if there are not enough")
    choice.add_argument(
        "--split", choices=("time", "sequence"), help="by stretches of time, or by whole sequences (places, groups)"
    )
    choice.add_argument(
        "--shares", type=_shares, default=(0.6, 0.2, 0.2), help="shares of the images per split (0.6,0.2,0.2)"
    )
    choice.add_argument("--split-gap", type=float, default=0.0, help="seconds left out between two splits (0)")
    for split in SPLITS:
        choice.add_argument(f"--{split}-sequences", type=_names, metavar="A,B", help=f"sequences (groups) of {split}")
    choice.add_argument(
        "--hard-negatives", type=Path, metavar="NPZ", help="choose negatives that are near by these features"
    )
    choice.add_argument("--hard-share", type=float, default=0.5, help="share of such negatives (0.5)")
    choice.add_argument(
        "--warp-share", type=float, default=0.0, help="share of pairs in which one image is a warped copy (0)"
    )
    choice.add_argument("--seed", type=seed, default=1, help="seed of the random choice (1)")


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
        features=read_features(arguments.hard_negatives) if arguments.hard_negatives else None,
        hard_share=arguments.hard_share,
        warp_share=1.0 if arguments.singles else arguments.warp_share,
    )
    lists = build_lists(source, plan, root, arguments.out, print, _warn, bar)
    print(f"wrote {', '.join(map(str, lists.values()))}; the names of images in them are relative to {root}/")


def _source(arguments: argparse.Namespace) -> tuple[PairSource, Path]:
    """Open the one source that is named; return it and the root folder."""
    sequences = _sequences(arguments)
    kinds = ("mask", "traverses", "nordland", "folders", "table", "singles")
    given = ["sequences"] if sequences else []
    given += [kind for kind in kinds if getattr(arguments, kind)]
    if arguments.index and "table" not in given:
        given.append("index")
    if "traverses" in given and "mask" in given:
        given.remove("mask")
    if len(given) != 1:
        raise WrongUsage(
            "name sequences or one of --mask, --traverses, --nordland, --folders, --table, --index, --singles"
        )
    kind = given[0]
    if kind == "mask" and not arguments.images:
        raise WrongUsage("--mask needs --images or --traverses")
    if kind == "traverses" and not arguments.mask:
        raise WrongUsage(
            "--traverses needs --mask, which says what shows the same place; --folders goes by equal names"
        )
    if kind == "index" and not (arguments.group and arguments.track and arguments.time):
        raise WrongUsage("--index without --table needs --group, --track and --time")
    places = {
        "sequences": [folder.resolve().parent for _, folder in sequences],
        "mask": [arguments.images],
        "traverses": arguments.traverses,
        "nordland": [arguments.nordland],
        "folders": arguments.folders,
        "table": [arguments.table.parent] if arguments.table else [],
        "index": [arguments.index.parent] if arguments.index else [],
        "singles": [arguments.singles],
    }[kind]
    warped = [arguments.out] if arguments.warp_share or arguments.singles else []
    root = arguments.root or Path(os.path.relpath(os.path.commonpath([str(p.resolve()) for p in [*places, *warped]])))
    if kind == "sequences":
        return _pose_source(arguments, sequences, root), root
    if kind == "traverses":
        return TraverseSource(arguments.mask, arguments.traverses[0], arguments.traverses[1], root), root
    if kind == "nordland":
        queries, references, truth = benchmark_parts(arguments.nordland)
        return TraverseSource(truth, queries, references, root), root
    min_gap = None if arguments.min_gap is None else int(arguments.min_gap)
    if kind == "mask":
        return MaskSource(arguments.mask, arguments.images, root, min_gap, arguments.camera), root
    if kind == "folders":
        return folders_source(arguments.folders[0], arguments.folders[1], root, min_gap or 0), root
    if kind == "table":
        return table_source(arguments.table, root, arguments.group, arguments.index), root
    if kind == "index":
        return index_source(
            arguments.index, root, arguments.group, arguments.track, arguments.time, arguments.max_gap
        ), root
    return singles_source(arguments.singles, root), root


def _sequences(arguments: argparse.Namespace) -> list[tuple[str, Path]]:
    """Return layout and folder of every sequence that is named; bags and videos are extracted below --out."""
    named = [("", path) for path in arguments.sequences]
    named += [(layout, path) for layout in LAYOUTS for path in getattr(arguments, layout)]
    if arguments.poses and len(named) != 1:
        raise WrongUsage("--poses are those of one sequence; name one")
    if arguments.pose_form and not arguments.poses:
        raise WrongUsage("--pose-form means nothing without --poses")
    found = []
    for layout, path in named:
        if layout in RECORDED or (not layout and is_recording(path)):
            folder, said = extract(path, arguments.out / path.stem, arguments.topic, arguments.pose_topic, bar)
            print(said)
            found.append(("images" if arguments.poses else "tum", folder))
        else:
            found.append((layout or layout_of(path, "images" if arguments.poses else "tum"), path))
    return found


def _pose_source(arguments: argparse.Namespace, named: list[tuple[str, Path]], root: Path) -> PoseSource:
    poses = PoseChoice(arguments.poses, pose_form(arguments.pose_form)) if arguments.poses else None
    sequences = [read_posed(folder, layout, arguments.max_difference, poses) for layout, folder in named]
    for (_, folder), sequence in zip(named, sequences, strict=True):
        print(f"{folder}: {len(sequence)} images with a pose, {sequence.dropped} without one left out")
        for doubt in sequence.doubts:
            _warn(doubt)
    rule = PoseRule(
        max_distance_m=arguments.max_distance,
        max_angle_deg=arguments.max_angle,
        min_gap_s=arguments.min_gap or 0.0,
        negatives=arguments.negatives,
        clear_distance_m=arguments.clear_distance,
        clear_view_angle_deg=arguments.clear_view_angle,
    )
    scenes = Scenes(tuple(arguments.same_scene), tuple(arguments.same_frame), arguments.different_scenes)
    folders = [Path(os.path.relpath(folder.resolve(), root.resolve())).as_posix() for _, folder in named]
    return PoseSource(sequences, folders, rule, scenes)


def _warn(doubt: str) -> None:
    print(f"warning: {doubt}", file=sys.stderr)


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

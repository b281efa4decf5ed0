"""Arguments that several commands have: data sets, descriptors, and which frames are compared."""

from __future__ import annotations

import argparse

from loopclosure.decision.constants import RECENT
from loopclosure.descriptors.similarity import METRICS
from loopclosure.places import datasets
from loopclosure.places.masks import CAMERAS
from loopclosure.places.same_place import MAX_ANGLE_DEG, MAX_DISTANCE_M
from loopclosure.places.source import LAYOUT_LINES, POSE_FORM_HELP, POSES_HELP
from netspec.terminal.parser import above_zero

HELP = f"""A SOURCE is [KIND:]PATH[,KEY=VALUE]..., for example tum:desk,stop=50%,stride=2.

Ground truth from poses (KIND may be omitted; it is then detected from the files):
{LAYOUT_LINES}
  images:     a folder or list of images, with poses=FILE, or with truth=MASK, which marks frames of the same place
Other ground truth:
  fabmap:     FAB-MAP's New College or City Centre; truth=, coordinates=, camera={"|".join(CAMERAS)} (default: both)
  traverses:  two drives, PATH and references=PATH; equal frame numbers show the same place, unless truth=FILE is given
  nordland:   query/, ref/, ground_truth*.json, as in VPR benchmarks
  pairs:      places that were photographed twice (pairs.csv)

KEYs: start, stop (a frame number N or a percentage P%), stride, limit: which frames to use;
truth=FILE (.mat .npy .txt or image); poses=FILE ({POSES_HELP}),
pose-form ({POSE_FORM_HELP});
references=PATH: another sequence to search; topic, pose-topic: the topics to read from a bag with several."""
EXCLUDED = f"fabmap {datasets.FABMAP_EXCLUSION.frames}, images {datasets.FOLDER_EXCLUSION.frames}"


def add_data_set(parser: argparse.ArgumentParser) -> None:
    """Add the arguments for a data set: its source (see HELP) and the rule for the same place."""
    parser.add_argument("source", metavar="SOURCE", help="the data set (see below)")
    parser.add_argument(
        "--tolerance",
        type=int,
        metavar="FRAMES",
        help="traverses: largest difference between frame numbers of the same place (default: 0)",
    )
    parser.add_argument(
        "--max-distance",
        type=above_zero,
        metavar="M",
        help=f"maximum distance between two poses of the same place (default: {MAX_DISTANCE_M:g})",
    )
    parser.add_argument(
        "--max-angle", type=above_zero, metavar="DEG", help=f"maximum angle between them (default: {MAX_ANGLE_DEG:g})"
    )
    parser.add_argument(
        "--exclude-frames",
        type=int,
        metavar="N",
        help=f"exclude pairs of frames i, j with |i - j| <= N (default: {EXCLUDED})",
    )
    parser.add_argument(
        "--exclude-seconds",
        type=float,
        metavar="S",
        help="exclude pairs of frames within S seconds "
        f"(default if frames have times: {datasets.TUM_EXCLUSION.seconds:g})",
    )


def keyword(text: str) -> tuple[str, str]:
    """Parse ``KEY=VALUE``."""
    key, equals, value = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"found {text}, expected KEY=VALUE")
    return key, value


def add_frames(parser: argparse.ArgumentParser, describe: str, file: str) -> None:
    """Add the arguments for descriptors, and for the frames that are compared.

    describe  the form of ``--describe``
    file      what else it may be, for its help
    """
    parser.add_argument(
        "--describe",
        default="default",
        metavar=describe,
        help="an included net (default or small), or a function from a BGR image (H, W, 3) to its descriptor" + file,
    )
    parser.add_argument(
        "--with",
        action="append",
        type=keyword,
        default=[],
        metavar="KEY=VALUE",
        help="keyword argument of the --describe function",
    )
    parser.add_argument(
        "--metric", choices=METRICS, default=METRICS[0], help="metric of the descriptors (default: %(default)s)"
    )
    parser.add_argument(
        "--exclude-recent",
        type=int,
        metavar="FRAMES",
        help="number of recent frames that are never candidates "
        f"(default: {RECENT}, or those of --exclude-seconds, and the length of a visit to the place)",
    )
    parser.add_argument(
        "--exclude-seconds", type=float, metavar="S", help="frames of the last S seconds are never candidates"
    )

"""``lmdb-build convert``, ``imageset``, ``mean``, ``mnist`` and ``cifar``, like Caffe's tools, and ``compare``.

Caffe: tools/convert_imageset.cpp, tools/compute_image_mean.cpp, examples/mnist, examples/siamese, examples/cifar10
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

from tqdm import tqdm

from lmdb_build.databases import (
    DatumOptions,
    Entry,
    image_key,
    pair_key,
    read_pairs,
    read_single_list,
    shuffled,
    write_databases,
)
from lmdb_build.datasets import convert_cifar, convert_mnist
from lmdb_build.mean import channel_means, compute_mean, write_mean
from netspec import log
from netspec.data.database import BACKENDS, open_reader
from netspec.errors import Where
from netspec.terminal.commands import WrongUsage, refuse
from netspec.terminal.output import bar
from netspec.terminal.parser import Commands


def add_commands(commands: Commands) -> None:
    """Add the commands of this module."""
    for name, function, what, epilog in (
        ("convert", _convert_pairs, "write the pairs of a list into a database (convert_pairs_lmdb)", OF_PAIRS),
        ("imageset", _convert_images, "write the images of a list into a database (convert_imageset)", OF_IMAGES),
    ):
        form = argparse.RawDescriptionHelpFormatter
        _add_image_list(commands.add_parser(name, function, help=what, epilog=epilog, formatter_class=form))
    _add_mean(commands)
    _add_mnist(commands)
    _add_cifar(commands)
    _add_compare(commands)


def _add_backend(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--backend", default="lmdb", choices=BACKENDS, help="format of the database (default: %(default)s)"
    )


def _add_image_list(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--gray", action="store_true", help="read images as grayscale")
    parser.add_argument("--shuffle", action="store_true", help="write in random order")
    parser.add_argument(
        "--seed", type=int, default=1, metavar="N", help="seed of the random order (default: %(default)s)"
    )
    _add_backend(parser)
    for option, side in (("--resize_width", "width"), ("--resize_height", "height")):
        parser.add_argument(
            option,
            type=int,
            default=0,
            metavar="N",
            help=f"resize images to this {side}; 0: do not resize (default: %(default)s)",
        )
    parser.add_argument("--check_size", action="store_true", help="refuse images of different sizes")
    parser.add_argument("--encoded", action="store_true", help="store encoded images")
    parser.add_argument(
        "--encode_type",
        default="",
        metavar="NAME",
        help="format of encoded images, such as png or jpg (default: each file's own)",
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=0,
        metavar="N",
        help="number of processes that read images; 0: one per core (default: %(default)s)",
    )
    parser.add_argument("rootfolder", metavar="ROOTFOLDER", help="folder that the names in the list are relative to")
    parser.add_argument(
        "listfile", metavar="LISTFILE", help="the list; blank lines and lines that begin with # are ignored"
    )
    parser.add_argument("db_name", metavar="DB_NAME", help="the database to write; it must not exist")


OF_PAIRS = """Write one Datum per pair into a database that Caffe reads; both images are stacked along the channels.
A line of LISTFILE is, for example, "a.png b.png 1". With -encoded, the databases are DB_NAME_a and DB_NAME_b."""
OF_IMAGES = """Write one Datum per image into a database that Caffe reads.
A line of LISTFILE is, for example, "subfolder/file.png 7". Unreadable images are skipped; the last line counts them."""


def _convert_pairs(arguments: argparse.Namespace) -> None:
    name = arguments.db_name.rstrip("/")
    twins = [f"{name}_a", f"{name}_b"] if _is_encoded(arguments) else [name]
    _convert(arguments, read_pairs, twins, pair_key, "pairs")


def _convert_images(arguments: argparse.Namespace) -> None:
    _convert(arguments, read_single_list, [arguments.db_name], image_key, "images", skip=True)


def _convert(
    arguments: argparse.Namespace,
    read: Callable[[str], list[Entry]],
    databases: list[str],
    key: Callable[[int, Entry], str],
    what: str,
    skip: bool = False,
) -> None:
    if not arguments.shuffle:
        refuse(arguments, ("seed",), "is for --shuffle")
    width, height = arguments.resize_width, arguments.resize_height
    if (width > 0) != (height > 0) or min(width, height) < 0:
        raise WrongUsage("-resize_width and -resize_height must both be given and be above 0")
    entries = read(arguments.listfile)
    if arguments.shuffle:
        log.info("convert_imageset.cpp:86", "Shuffling data")
        log.info("convert_imageset.cpp:86", f"Shuffled with seed {arguments.seed} (-seed)")
        entries = shuffled(entries, arguments.seed)
    log.info("convert_imageset.cpp:89", f"A total of {len(entries)} {what}.")
    if arguments.encode_type and not arguments.encoded:
        log.info("convert_imageset.cpp:92", "encode_type specified, assuming encoded=true.")
    options = DatumOptions(
        color=not arguments.gray,
        size=(height, width) if height else None,
        encoding=arguments.encode_type.lstrip(".") if _is_encoded(arguments) else None,
        backend=arguments.backend,
        check_size=arguments.check_size,
        skip=skip,
        workers=arguments.workers,
    )
    write_databases(entries, arguments.rootfolder, databases, options, key, bar)


def _is_encoded(arguments: argparse.Namespace) -> bool:
    return arguments.encoded or bool(arguments.encode_type)


def _add_mean(commands: Commands) -> None:
    parser = commands.add_parser("mean", _mean, help="compute the mean image of a database (compute_image_mean)")
    _add_backend(parser)
    parser.add_argument("input_db", metavar="INPUT_DB", help="the database to read")
    parser.add_output("output_file", nargs="?", metavar="OUTPUT_FILE", help="where to write the mean, as .binaryproto")


def _mean(arguments: argparse.Namespace) -> None:
    mean = compute_mean(open_reader(arguments.input_db, arguments.backend), Where(arguments.input_db))
    if arguments.output_file:
        write_mean(arguments.output_file, mean)
    channel_means(mean)


def _add_mnist(commands: Commands) -> None:
    parser = commands.add_parser("mnist", _mnist, help="write the MNIST files into a database (convert_mnist_data)")
    _add_backend(parser)
    parser.add_argument("--pairs", action="store_true", help="write randomly chosen pairs (convert_mnist_siamese_data)")
    parser.add_argument("images", metavar="IMAGES", help="uncompressed file of images, such as train-images-idx3-ubyte")
    parser.add_argument("labels", metavar="LABELS", help="uncompressed file of labels, such as train-labels-idx1-ubyte")
    parser.add_argument("db_name", metavar="DB_NAME", help="the database to write; it must not exist")


def _mnist(arguments: argparse.Namespace) -> None:
    name = arguments.db_name.rstrip("/")
    convert_mnist(arguments.images, arguments.labels, name, arguments.backend, bar, arguments.pairs)


def _add_cifar(commands: Commands) -> None:
    parser = commands.add_parser(
        "cifar", _cifar, help="write the CIFAR-10 files into two databases (convert_cifar_data)"
    )
    parser.add_argument(
        "input_folder",
        metavar="INPUT_FOLDER",
        help="folder with data_batch_1.bin to data_batch_5.bin and test_batch.bin",
    )
    parser.add_argument(
        "output_folder",
        metavar="OUTPUT_FOLDER",
        help="folder for cifar10_train_DB_TYPE and cifar10_test_DB_TYPE",
    )
    parser.add_argument("db_type", choices=BACKENDS, help="format of the databases")


def _cifar(arguments: argparse.Namespace) -> None:
    convert_cifar(arguments.input_folder, arguments.output_folder, arguments.db_type, bar)


def _add_compare(commands: Commands) -> None:
    parser = commands.add_parser(
        "compare", _compare, help="train Siamese nets on the same pairs and print a table of their results"
    )
    parser.add_argument("solver", nargs="+", metavar="SOLVER", help="solver prototxt of a Siamese net")
    parser.add_argument(
        "--train",
        action="store_true",
        default=True,
        help="train the nets (the default); --no-train evaluates the snapshots of an earlier training",
    )
    parser.add_output(
        "--out",
        folder=True,
        type=Path,
        default=Path("out/compare"),
        metavar="FOLDER",
        help="folder for the results (default: out/compare)",
    )
    parser.add_argument(
        "--resume", action="store_true", help="resume each training from its newest snapshot, if there is one"
    )
    parser.add_argument(
        "--test",
        action="append",
        default=[],
        metavar="DATABASE",
        help="also evaluate the nets on the pairs of this database; give it once for each data layer of the nets",
    )
    parser.add_argument("--gpu", default="", metavar="N", help="number of the GPU to use (default: the CPU)")
    parser.add_argument(
        "--precision",
        default="fp32",
        choices=["fp32", "tf32", "bf16", "fp16"],
        help="precision of the trainings; the nets are evaluated in fp32 (default: %(default)s)",
    )
    parser.add_argument(
        "--snapshot",
        default="best",
        choices=["best", "last"],
        help="evaluate the snapshot with the lowest validation loss (best), or that of the last iteration "
        "(default: %(default)s)",
    )


def _left(done: int, to_do: int, seconds: float) -> str:
    """Return how long a training will still take, if ``done`` iterations took so many seconds."""
    if done < 50 or to_do <= 0:  # too early to say, or the end
        return ""
    return f", about {timedelta(seconds=round(seconds / done * to_do))} left"


def _compare(arguments: argparse.Namespace) -> None:
    from lmdb_build.compare import Choices, compare  # loads the plotting library

    shown: tqdm | None = None  # the bar of the training, on a terminal
    first, began, last = 0, 0.0, math.inf  # the training's first iteration, and the time then; the last one of any

    def say(line: str) -> None:
        tqdm.write(line, file=sys.stderr)
        sys.stderr.flush()

    def step(done: int, total: int, loss: str) -> None:
        nonlocal shown, first, began, last
        terminal = sys.stderr.isatty()
        if done <= last:  # the next training
            first, began = done, time.monotonic()
            shown = tqdm(total=total, initial=done, desc="train", unit="", leave=False) if terminal else None
        last = done
        if shown is None:
            left = _left(done - first, total - done, time.monotonic() - began)
            say(f"Iteration {done} of {total}, loss = {loss}{left}")
            return
        shown.set_postfix_str(f"loss {loss}", refresh=False)
        shown.update(done - shown.n)
        if done == total:
            shown.close()

    databases = tuple(arguments.test)
    choices = Choices(
        arguments.train, arguments.resume, databases, arguments.gpu, arguments.precision, arguments.snapshot
    )
    tables, files = compare(arguments.solver, arguments.out, choices, say, step)
    print(tables)
    for path in files:
        say(f"wrote {path}")

"""``lmdb-build convert``, ``imageset``, ``mean``, ``mnist`` and ``cifar``: arguments and log of Caffe's tools.

Caffe: tools/convert_imageset.cpp, tools/compute_image_mean.cpp, examples/mnist, examples/siamese, examples/cifar10
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

from lmdb_build.databases import (
    Entry,
    Options,
    image_key,
    pair_key,
    read_pairs,
    read_single_list,
    shuffled,
    write_databases,
)
from lmdb_build.datasets import convert_cifar, convert_mnist
from netspec import log
from netspec.data.database import BACKENDS, open_reader
from netspec.data.mean import channel_means, compute_mean, write_mean
from netspec.errors import Where
from netspec.terminal.commands import Commands, WrongUsage, refuse
from netspec.terminal.output import bar


def add_to(commands: Commands) -> None:
    """Add the commands."""
    p = commands.add("convert", _convert_pairs, "write the pairs of a list into a database (convert_pairs_lmdb)")
    p.description = (
        "Write one Datum per pair of images, both stacked along the channels, into a database that Caffe reads. A line"
        " of LISTFILE is: a.png b.png 1. With -encoded the databases are DB_NAME_a and DB_NAME_b."
    )
    _add_flags(p)

    p = commands.add("imageset", _convert_images, "write the images of a list into a database (convert_imageset)")
    p.description = (
        "Write one Datum per image into a database that Caffe reads. A line of LISTFILE is: subfolder/file.png 7."
        " Images that cannot be read are left out, and counted in the last line."
    )
    _add_flags(p)

    p = commands.add("mean", _mean, "compute the mean image of a database (compute_image_mean)")
    _add_backend(p)
    p.add_argument("INPUT_DB", help="the database to read")
    p.add_argument("OUTPUT_FILE", nargs="?", help="where to write the mean, as .binaryproto")

    p = commands.add("mnist", _mnist, "write the files of MNIST into a database (convert_mnist_data)")
    _add_backend(p)
    p.add_argument("--pairs", action="store_true", help="write pairs chosen at random (convert_mnist_siamese_data)")
    p.add_argument("IMAGES", help="the file of images, unpacked: train-images-idx3-ubyte")
    p.add_argument("LABELS", help="the file of labels, unpacked: train-labels-idx1-ubyte")
    p.add_argument("DB_NAME", help="the database to write; it must not exist")

    p = commands.add("cifar", _cifar, "write the files of CIFAR-10 into two databases (convert_cifar_data)")
    p.add_argument("INPUT_FOLDER", help="the folder of data_batch_1.bin to data_batch_5.bin and test_batch.bin")
    p.add_argument("OUTPUT_FOLDER", help="where cifar10_train_DB_TYPE and cifar10_test_DB_TYPE are written")
    p.add_argument("DB_TYPE", choices=BACKENDS, help="the form of the databases")


def _add_backend(p: argparse.ArgumentParser) -> None:
    p.add_argument("--backend", default="lmdb", choices=BACKENDS, help="backend of the database (default: lmdb)")


def _add_flags(p: argparse.ArgumentParser) -> None:
    p.add_argument("--gray", action="store_true", help="read images as grayscale")
    p.add_argument("--shuffle", action="store_true", help="write in random order")
    p.add_argument("--seed", type=int, default=1, help="seed of the random order (default: 1)")
    _add_backend(p)
    p.add_argument("--resize_width", type=int, default=0, help="resize images to this width")
    p.add_argument("--resize_height", type=int, default=0, help="resize images to this height")
    p.add_argument("--check_size", action="store_true", help="refuse images of different sizes")
    p.add_argument("--encoded", action="store_true", help="store encoded images")
    p.add_argument(
        "--encode_type", default="", help="format to encode images in (png, jpg, ...); by default each file's own"
    )
    p.add_argument("--workers", type=int, default=0, help="processes that read images; 0: one per core (default: 0)")
    p.add_argument("ROOTFOLDER", help="folder that the names in the list are relative to")
    p.add_argument("LISTFILE", help="the list; blank lines and lines that begin with # are ignored")
    p.add_argument("DB_NAME", help="the database to write; it must not exist")


def _convert_pairs(arguments: argparse.Namespace) -> None:
    name = arguments.DB_NAME.rstrip("/")
    twins = [f"{name}_a", f"{name}_b"] if _is_encoded(arguments) else [name]
    _convert(arguments, read_pairs, twins, pair_key, "pairs")


def _convert_images(arguments: argparse.Namespace) -> None:
    _convert(arguments, read_single_list, [arguments.DB_NAME], image_key, "images", skip=True)


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
        raise WrongUsage("-resize_width and -resize_height must both be given, and be above 0")
    entries = read(arguments.LISTFILE)
    if arguments.shuffle:
        log.info("convert_imageset.cpp:86", "Shuffling data")
        log.info("convert_imageset.cpp:86", f"Shuffled with seed {arguments.seed} (-seed)")
        entries = shuffled(entries, arguments.seed)
    log.info("convert_imageset.cpp:89", f"A total of {len(entries)} {what}.")
    if arguments.encode_type and not arguments.encoded:
        log.info("convert_imageset.cpp:92", "encode_type specified, assuming encoded=true.")
    options = Options(
        color=not arguments.gray,
        size=(height, width) if height else None,
        encoding=arguments.encode_type.lstrip(".") if _is_encoded(arguments) else None,
        backend=arguments.backend,
        check_size=arguments.check_size,
        skip=skip,
    )
    write_databases(entries, arguments.ROOTFOLDER, databases, options, key, arguments.workers, bar)


def _is_encoded(arguments: argparse.Namespace) -> bool:
    return arguments.encoded or bool(arguments.encode_type)


def _mean(arguments: argparse.Namespace) -> None:
    mean = compute_mean(open_reader(arguments.INPUT_DB, arguments.backend), Where(arguments.INPUT_DB))
    if arguments.OUTPUT_FILE:
        write_mean(arguments.OUTPUT_FILE, mean)
    channel_means(mean)


def _mnist(arguments: argparse.Namespace) -> None:
    name = arguments.DB_NAME.rstrip("/")
    convert_mnist(arguments.IMAGES, arguments.LABELS, name, arguments.backend, bar, arguments.pairs)


def _cifar(arguments: argparse.Namespace) -> None:
    convert_cifar(arguments.INPUT_FOLDER, arguments.OUTPUT_FOLDER, arguments.DB_TYPE, bar)

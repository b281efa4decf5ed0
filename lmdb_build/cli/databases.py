"""``lmdb-build convert``, ``imageset``, ``mean``, ``mnist``, ``cifar``, as Caffe's tools; and ``compare``.

Caffe: tools/convert_imageset.cpp, tools/compute_image_mean.cpp, examples/mnist, examples/siamese, examples/cifar10
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from tqdm import tqdm

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
from netspec.terminal.commands import WrongUsage, refuse
from netspec.terminal.output import bar


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
        raise WrongUsage("-resize_width and -resize_height must both be given, and be above 0")
    entries = read(arguments.listfile)
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
    write_databases(entries, arguments.rootfolder, databases, options, key, arguments.workers, bar)


def _is_encoded(arguments: argparse.Namespace) -> bool:
    return arguments.encoded or bool(arguments.encode_type)


def _mean(arguments: argparse.Namespace) -> None:
    mean = compute_mean(open_reader(arguments.input_db, arguments.backend), Where(arguments.input_db))
    if arguments.output_file:
        write_mean(arguments.output_file, mean)
    channel_means(mean)


def _mnist(arguments: argparse.Namespace) -> None:
    name = arguments.db_name.rstrip("/")
    convert_mnist(arguments.images, arguments.labels, name, arguments.backend, bar, arguments.pairs)


def _cifar(arguments: argparse.Namespace) -> None:
    convert_cifar(arguments.input_folder, arguments.output_folder, arguments.db_type, bar)


def _compare(arguments: argparse.Namespace) -> None:
    from lmdb_build.compare import compare  # which loads the plotting library

    shown: list[tqdm] = []  # the bar of the training, on a terminal

    def say(line: str) -> None:
        tqdm.write(line, file=sys.stderr)
        sys.stderr.flush()

    def step(done: int, total: int, loss: str) -> None:
        if not sys.stderr.isatty():
            say(f"Iteration {done} of {total}, loss = {loss}")
            return
        if done == 0:
            shown[:] = [tqdm(total=total, desc="train", unit="", leave=False)]
        for training in shown:
            training.set_postfix_str(f"loss {loss}", refresh=False)
            training.update(done - training.n)
            if done == total:
                training.close()

    table, files = compare(arguments.solver, arguments.out, arguments.train, arguments.gpu, say, step)
    print(table)
    for path in files:
        say(f"wrote {path}")


BACKEND = ("--backend", BACKENDS, "lmdb", "backend of the database")
IMAGES = (
    ("--gray", bool, False, "read images as grayscale"),
    ("--shuffle", bool, False, "write in random order"),
    ("--seed N", int, 1, "seed of the random order"),
    BACKEND,
    ("--resize_width N", int, 0, "resize images to this width"),
    ("--resize_height N", int, 0, "resize images to this height"),
    ("--check_size", bool, False, "refuse images of different sizes"),
    ("--encoded", bool, False, "store encoded images"),
    ("--encode_type NAME", str, "", "format to encode images in (png, jpg, ...); by default each file's own"),
    ("--workers N", int, 0, "processes that read images; 0: one per core"),
    ("ROOTFOLDER", str, None, "folder that the names in the list are relative to"),
    ("LISTFILE", str, None, "the list; blank lines and lines that begin with # are ignored"),
    ("DB_NAME", str, None, "the database to write; it must not exist"),
)
MEAN = (
    BACKEND,
    ("INPUT_DB", str, None, "the database to read"),
    ("[OUTPUT_FILE]", str, None, "where to write the mean, as .binaryproto"),
)
MNIST = (
    BACKEND,
    ("--pairs", bool, False, "write pairs chosen at random (convert_mnist_siamese_data)"),
    ("IMAGES", str, None, "the file of images, unpacked: train-images-idx3-ubyte"),
    ("LABELS", str, None, "the file of labels, unpacked: train-labels-idx1-ubyte"),
    ("DB_NAME", str, None, "the database to write; it must not exist"),
)
CIFAR = (
    ("INPUT_FOLDER", str, None, "the folder of data_batch_1.bin to data_batch_5.bin and test_batch.bin"),
    ("OUTPUT_FOLDER", str, None, "where cifar10_train_DB_TYPE and cifar10_test_DB_TYPE are written"),
    ("DB_TYPE", BACKENDS, None, "the form of the databases"),
)
COMPARE = (
    ("SOLVER...", str, None, "solver prototxt files of Siamese nets"),
    ("--train", bool, True, "the default; --no-train evaluates the snapshots of an earlier training"),
    ("--out FOLDER", Path, Path("out/compare"), "folder for all files (default: out/compare)"),
    ("--gpu N", str, "", "the number of the GPU to use (default: the CPU)"),
)
OF_PAIRS = """Write one Datum per pair of images, both stacked along the channels, into a database that Caffe reads.
A line of LISTFILE is: a.png b.png 1. With -encoded the databases are DB_NAME_a and DB_NAME_b."""
OF_IMAGES = """Write one Datum per image into a database that Caffe reads. A line of LISTFILE is: subfolder/file.png 7.
Images that cannot be read are left out, and counted in the last line."""
COMMANDS = (
    ("convert", _convert_pairs, "write the pairs of a list into a database (convert_pairs_lmdb)", IMAGES, OF_PAIRS),
    ("imageset", _convert_images, "write the images of a list into a database (convert_imageset)", IMAGES, OF_IMAGES),
    ("mean", _mean, "compute the mean image of a database (compute_image_mean)", MEAN),
    ("mnist", _mnist, "write the files of MNIST into a database (convert_mnist_data)", MNIST),
    ("cifar", _cifar, "write the files of CIFAR-10 into two databases (convert_cifar_data)", CIFAR),
    ("compare", _compare, "train nets on the same pairs and print the table that compares them", COMPARE),
)

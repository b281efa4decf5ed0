"""convert_pairs_lmdb, convert_imageset and compute_image_mean: Caffe's command lines around the writer.

Flags are read as gflags reads them: one dash or two, ``-flag value`` or ``-flag=value``, ``-gray``, ``-nogray``,
``-gray=true``.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Sequence

import numpy as np
from tqdm.contrib.logging import logging_redirect_tqdm

from lmdb_build.bar import bar
from lmdb_build.databases import Entry, Options, image_key, pair_key, read_pairs, read_single_list, write_databases
from loopclosure.errors import InputError
from netspec import log
from netspec.data.database import BACKENDS, open_reader
from netspec.data.mean import channel_means, compute_mean, write_mean
from netspec.data.random_words import permutation
from netspec.errors import SpecError, Where

SWITCHES = ("gray", "shuffle", "check_size", "encoded")
TRUE, FALSE = ("true", "t", "yes", "y", "1"), ("false", "f", "no", "n", "0")


def convert_pairs_lmdb(arguments: Sequence[str] | None = None) -> int:
    """Write the pairs of a list into a database; return the exit status."""
    return _run(_convert_pairs, arguments)


def convert_imageset(arguments: Sequence[str] | None = None) -> int:
    """Write the images of a list into a database, as Caffe's tool does; return the exit status."""
    return _run(_convert_images, arguments)


def compute_image_mean(arguments: Sequence[str] | None = None) -> int:
    """Compute the mean image of a database, as Caffe's tool does; return the exit status."""
    return _run(_compute_mean, arguments)


def _convert_pairs(arguments: Sequence[str]) -> None:
    args = _parse(
        "convert_pairs_lmdb",
        "Write one Datum a pair of images, both stacked along the channels, into a database that Caffe reads. A line of"
        " LISTFILE is: a.png b.png 1. With -encoded the databases are DB_NAME_a and DB_NAME_b.",
        arguments,
    )
    name = args.DB_NAME.rstrip("/")
    options = _options(args)
    paths = [name] if options.encoding is None else [f"{name}_a", f"{name}_b"]
    _convert(args, read_pairs(args.LISTFILE), paths, options, pair_key)


def _convert_images(arguments: Sequence[str]) -> None:
    args = _parse(
        "convert_imageset",
        "Write one Datum an image into a database that Caffe reads. A line of LISTFILE is: subfolder/file.png 7",
        arguments,
    )
    _convert(args, read_single_list(args.LISTFILE), [args.DB_NAME], _options(args), image_key)


def _convert(
    args: argparse.Namespace,
    entries: list[Entry],
    paths: list[str],
    options: Options,
    key: Callable[[int, Entry], str],
) -> None:
    if args.shuffle:
        log.info("convert_imageset.cpp:86", "Shuffling data")
        log.info("convert_imageset.cpp:86", f"Shuffled with seed {args.seed} (-seed)")
        order: np.ndarray = permutation(args.seed, "convert/shuffle", len(entries))
        entries = [entries[i] for i in order]
    what = "images" if key is image_key else "pairs"
    log.info("convert_imageset.cpp:89", f"A total of {len(entries)} {what}.")
    write_databases(entries, args.ROOTFOLDER, paths, options, key, args.backend, args.check_size, args.workers, bar)


def _options(args: argparse.Namespace) -> Options:
    if args.encode_type and not args.encoded:
        log.info("convert_imageset.cpp:92", "encode_type specified, assuming encoded=true.")
    encoding = args.encode_type.lstrip(".") if args.encoded or args.encode_type else None
    size = (args.resize_height, args.resize_width) if args.resize_height else None
    return Options(color=not args.gray, size=size, encoding=encoding)


def _compute_mean(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(
        "compute_image_mean", description="Compute the mean image of a database.", allow_abbrev=False
    )
    _flag(parser, "backend", "lmdb", "of the database", choices=BACKENDS)
    parser.add_argument("INPUT_DB")
    parser.add_argument("OUTPUT_FILE", nargs="?", help="where to write the mean, as .binaryproto")
    args = parser.parse_args(arguments)
    mean = compute_mean(open_reader(args.INPUT_DB, args.backend), Where(args.INPUT_DB))
    if args.OUTPUT_FILE:
        write_mean(args.OUTPUT_FILE, mean)
    channel_means(mean)


def _parse(program: str, description: str, arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(program, description=description, allow_abbrev=False)
    _flag(parser, "gray", False, "read images as grey")
    _flag(parser, "shuffle", False, "write in random order")
    _flag(parser, "seed", 1, "of the random order")
    _flag(parser, "backend", "lmdb", "of the database", choices=BACKENDS)
    _flag(parser, "resize_width", 0, "width images are resized to")
    _flag(parser, "resize_height", 0, "height images are resized to")
    _flag(parser, "check_size", False, "refuse images of different sizes")
    _flag(parser, "encoded", False, "store encoded images")
    _flag(parser, "encode_type", "", "format to encode images in (png, jpg, ...); by default each file's own")
    _flag(parser, "workers", 0, "processes that read images; 0: one a core")
    parser.add_argument("ROOTFOLDER", help="folder in front of the names in the list")
    parser.add_argument("LISTFILE", help="blank lines and those that begin with # are passed over")
    parser.add_argument("DB_NAME", help="the database to write; it must not exist")
    args = parser.parse_args(_spell_out(arguments))
    if (args.resize_width > 0) != (args.resize_height > 0) or min(args.resize_width, args.resize_height) < 0:
        parser.error("-resize_width and -resize_height go together, both above 0")
    return args


def _flag(parser: argparse.ArgumentParser, name: str, default: object, text: str, **more: object) -> None:
    kind = _truth if isinstance(default, bool) else type(default)
    shown = f"{text} (default: {default})" if default not in ("", False) else text
    parser.add_argument(f"-{name}", f"--{name}", default=default, type=kind, help=shown, **more)  # type: ignore[arg-type]


def _truth(word: str) -> bool:
    if word.lower() not in TRUE + FALSE:
        raise argparse.ArgumentTypeError(f"found {word!r}, expected true or false")
    return word.lower() in TRUE


def _spell_out(arguments: Sequence[str]) -> list[str]:
    """Give a switch its value, so that it does not take the next word: -gray -> -gray=true, -nogray -> -gray=false."""
    spelled = []
    for word in arguments:
        name = word.lstrip("-")
        if word.startswith("-") and name in SWITCHES:
            word = f"-{name}=true"
        elif word.startswith("-") and name.startswith("no") and name[2:] in SWITCHES:
            word = f"-{name[2:]}=false"
        spelled.append(word)
    return spelled


def _run(command: Callable[[Sequence[str]], None], arguments: Sequence[str] | None) -> int:
    """Run a command with Caffe's log on stderr; a fault of the user's files is one line and status 1."""
    handler = logging.StreamHandler()
    handler.setFormatter(log.GlogFormatter())
    log.logger.addHandler(handler)
    log.logger.setLevel(logging.INFO)
    try:
        with logging_redirect_tqdm([log.logger]):
            command(sys.argv[1:] if arguments is None else arguments)
    except (SpecError, InputError) as fault:
        print(fault, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted; nothing was written", file=sys.stderr)
        return 130
    finally:
        log.logger.removeHandler(handler)
    return 0

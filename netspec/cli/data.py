"""``netspec data``."""

from __future__ import annotations

import argparse
import json
import sys
from functools import partial
from typing import TYPE_CHECKING

from netspec.cli.arguments import positive
from netspec.cli.run import Commands
from netspec.errors import printable
from netspec.terminal.commands import DONE, FAULT, WrongUsage, refuse
from netspec.terminal.output import bar

if TYPE_CHECKING:
    from netspec.data.records import Records
    from netspec.data.survey import Survey

SHOW, STAT = "show", "stat"
SHOWN_FAULTS = 4  # which come first


def add_to(commands: Commands) -> None:
    """Add the command."""
    p = commands.add("data", _data, "look at a database: a sheet of its records, or its statistics", quiet=True)
    p.add_argument("what", choices=(SHOW, STAT), help="show: draw records, labels, statistics; stat: print statistics")
    p.add_argument("source", metavar="DB", help="an LMDB, a LevelDB, an HDF5 file, or a list of HDF5 files")
    p.add_argument("--records", type=positive, metavar="N", help="look at N records, evenly spread (default: all)")
    p.add_argument("--out", metavar="F.png|svg", help="show: the picture to write")
    p.add_argument("--count", type=positive, default=40, help="show: how many records to draw (default: 40)")
    p.add_argument("--start", type=int, metavar="K", help="show: draw the records from number K on (default: a spread)")
    p.add_argument(
        "--images",
        type=positive,
        metavar="N",
        help="show: images side by side in a record (default: 2 of 2 or 6 channels)",
    )
    p.add_argument("--json", action="store_true", help="stat: print JSON")


def _data(arguments: argparse.Namespace) -> int:
    from netspec.data.records import open_records, spread
    from netspec.data.survey import survey

    if arguments.what == SHOW:
        refuse(arguments, ("json",), "is for `data stat`")
        if not arguments.out:
            raise WrongUsage("`data show` needs --out F.png")
    else:
        refuse(arguments, ("out", "count", "start", "images"), "is for `data show`")
    records = open_records(arguments.source)
    if arguments.start is not None and not 0 <= arguments.start < len(records):
        raise WrongUsage(f"found --start {arguments.start}, expected 0 to {len(records) - 1}")
    found = survey(records, spread(len(records), arguments.records), partial(bar, stage="look", unit="record"))
    if arguments.what == STAT:
        return _tell(arguments, found)
    _show(arguments, records, found)
    return DONE


def _tell(arguments: argparse.Namespace, found: Survey) -> int:
    from netspec.data.survey import as_json, as_lines

    if arguments.json:
        print(json.dumps(as_json(found)))
    else:
        print("\n".join(printable(line) for line in as_lines(found, arguments.source)))
    for fault in found.faults:
        print(printable(f'{arguments.source}: record "{fault.key}" {fault.text}'), file=sys.stderr)
    if found.num_faults > len(found.faults):
        print(f"and {found.num_faults - len(found.faults):,} more", file=sys.stderr)
    return FAULT if found.num_faults else DONE


def _show(arguments: argparse.Namespace, records: Records, found: Survey) -> None:
    from netspec.data.records import spread
    from netspec.inspect.draw.sheet import sheet
    from netspec.inspect.draw.style import ending_of, write_figure

    ending_of(arguments.out, ("png", "svg"))
    if arguments.start is None:
        faulty = [fault.number for fault in found.faults[:SHOWN_FAULTS]]
        numbers = faulty + [k for k in spread(len(records), arguments.count) if k not in faulty][: -len(faulty) or None]
    else:
        numbers = list(range(arguments.start, min(arguments.start + arguments.count, len(records))))
    write_figure(sheet([records[k] for k in numbers], found, arguments.source, arguments.images), arguments.out)
    print(f"{arguments.out}: {len(numbers)} of {len(records):,} records")

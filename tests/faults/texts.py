"""Texts with randomly replaced words: every reader of text must end with one error of its own kind.

    python tests/faults/texts.py [--tries 1000] [FORMAT ...]

mutate.py damages the bytes of good files; here, whole words and signs of a good text are replaced by others, by unusual
numbers and by any characters. Hypothesis chooses them, and shortens a text that is a fault.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from hypothesis import HealthCheck, given, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402

from faults.formats import FORMATS, NET, Format, text  # noqa: E402
from faults.mutate import ending  # noqa: E402
from netspec import log  # noqa: E402
from netspec.inspect.check.check import check_file  # noqa: E402

SOLVER = 'net: "x.prototxt" base_lr: 0.1 lr_policy: "step" gamma: 0.5 stepsize: 10 max_iter: 3 test_iter: 1\n'
TEXTS = {
    "net": Format(".prototxt", text(NET), check_file),
    "solver": Format(".prototxt", text(SOLVER), check_file),
    **{name: form for name, form in FORMATS.items() if form.suffix in (".txt", ".json", ".extra")},
}
ODD = ("", *"-0 1e999 nan inf 0x1F 010 1_0 \" ' \\ #".split(), "\r", "\t", "\x00", *"٣ [ }".split(), "\n\n")


def texts(good: str) -> st.SearchStrategy[str]:
    """Return texts like a good one, in which some words and signs in a row are replaced, twice."""
    tokens = re.findall(r"\w+|\s|[^\w\s]", good)
    anything = st.text(st.characters(exclude_categories=("Cs",)), max_size=4)
    words, numbers = st.sampled_from(sorted(set(tokens))), st.integers().map(str)
    pieces = st.one_of(words, st.sampled_from(ODD), numbers, st.floats().map(repr), anything)
    places = st.integers(0, len(tokens))
    cut = st.tuples(places, st.integers(0, 3), st.lists(pieces, max_size=4))

    def made(cuts: list[tuple[int, int, list[str]]]) -> str:
        changed = list(tokens)
        for start, length, words in cuts:
            changed[start : start + length] = words
        return "".join(changed)

    return st.lists(cut, min_size=1, max_size=3).map(made)


def try_format(form: Format, tries: int, folder: Path) -> str:
    """Read so many texts; return "" or what went wrong with the shortest."""
    good = folder / f"good{form.suffix}"
    form.write(good)

    calm = [HealthCheck.too_slow]

    @settings(max_examples=tries, deadline=100_000, database=None, derandomize=True, suppress_health_check=calm)
    @given(texts(good.read_text()))
    def ends_well(words: str) -> None:
        said = ending(form, folder, words.encode())
        assert not said, f"{said}: {words!r}"

    try:
        ends_well()
    except AssertionError as fault:
        return str(fault).partition("\n")[0]
    return ""


def main() -> int:
    """Try all formats that are asked for; return 1 if one has a fault."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tries", type=int, default=1000)
    parser.add_argument("formats", nargs="*", metavar="FORMAT", help=f"some of {', '.join(TEXTS)} (default: all)")
    arguments = parser.parse_args()
    faults = 0
    with tempfile.TemporaryDirectory() as folder, log.silent():
        for name in arguments.formats or TEXTS:
            said = try_format(TEXTS[name], arguments.tries, Path(folder))
            faults += bool(said)
            print(f"{name}: {said or f'{arguments.tries} texts, no fault'}", flush=True)
    return min(faults, 1)


if __name__ == "__main__":
    sys.exit(main())

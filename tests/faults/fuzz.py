"""Coverage-guided fuzzing: libFuzzer, through atheris, searches for inputs that reach new code in a reader.

    pip install -e ".[fuzz]"
    python tests/faults/fuzz.py FORMAT [libFuzzer's options, such as -runs=100000 or -max_total_time=60, and a corpus]

mutate.py defines what counts as a fault. The input that causes one is written to ``crash-...`` in the current folder.
"""

from __future__ import annotations

import importlib
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

atheris: Any = importlib.import_module("atheris")  # of the extra "fuzz"
ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

with atheris.instrument_imports(include=["netspec", "loopclosure", "lmdb_build"]):
    from faults.formats import FORMATS
    from faults.mutate import ending
    from netspec import log


def main(words: list[str]) -> None:
    name, *options = words or [""]
    if name not in FORMATS:
        raise SystemExit(f"name a format: {', '.join(FORMATS)}")
    form = FORMATS[name]
    log.logger.disabled = True
    with tempfile.TemporaryDirectory() as place:
        folder, seeds = Path(place, "read"), Path(place, "seeds")
        folder.mkdir()
        seeds.mkdir()
        (seeds / "good").write_bytes(form.open(form.good(folder)))

        def one(data: bytes) -> None:
            if said := ending(form, folder, form.close(data)):
                os.write(2, f"{said}\n".encode())
                raise AssertionError(said)

        size = f"-max_len={4 * (seeds / 'good').stat().st_size}"
        limits = ["-timeout=10", "-rss_limit_mb=1600", size]
        atheris.Setup([sys.argv[0], *limits, *options, str(seeds)], one)
        atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv[1:])

#!/usr/bin/env python3
"""Train nets on the same pairs and compare them (the paper's Table I), as ``lmdb-build compare`` does.

tools/compare.py prototxt/small/siamese_8/solver.prototxt prototxt/small/siamese_128/solver.prototxt
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from lmdb_build.cli import main

sys.exit(main(["compare", *sys.argv[1:]]))

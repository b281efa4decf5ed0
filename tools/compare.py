#!/usr/bin/env python3
"""Train nets on the same pairs and compare them (the paper's Table I), as ``lmdb-build compare`` does.

tools/compare.py prototxt/small/siamese_8/solver.prototxt prototxt/small/siamese_128/solver.prototxt
"""

import sys

from launch import run

sys.exit(run("lmdb_build.cli", "compare"))

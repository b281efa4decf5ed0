#!/usr/bin/env python3
"""Train a net: ``tools/train.py solver.prototxt``, with the options of ``netspec train``."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from netspec.cli import main

sys.exit(main(["train", *sys.argv[1:]]))

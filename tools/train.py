#!/usr/bin/env python3
"""Train a net: ``tools/train.py solver.prototxt``, with the options of ``netspec train``."""

import sys

from launch import run

sys.exit(run("netspec.cli", "train"))

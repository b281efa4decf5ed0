#!/usr/bin/env python3
"""Evaluate loop closure on a data set: ``tools/evaluate_loops.py``, with the options of ``loopclosure evaluate``."""

import sys

from launch import run

sys.exit(run("loopclosure.cli", "evaluate"))

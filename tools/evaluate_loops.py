#!/usr/bin/env python3
"""Judge loop closure on a data set: ``tools/evaluate_loops.py``, with the options of ``loopclosure evaluate``."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from loopclosure.cli import evaluate_loops

sys.exit(evaluate_loops())

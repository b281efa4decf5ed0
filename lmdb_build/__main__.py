"""``python -m lmdb_build``."""

import sys

from lmdb_build.cli import main

sys.exit(main())

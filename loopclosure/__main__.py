"""``python -m loopclosure``."""

import sys

from loopclosure.cli import main

sys.exit(main())

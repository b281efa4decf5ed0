"""The program ``netspec``, and ``python -m netspec``."""

import sys

from netspec.terminal.main import program


def main() -> int:
    """Run one command of netspec."""
    return program("netspec.cli")


if __name__ == "__main__":
    sys.exit(main())

"""The program ``loopclosure``, and ``python -m loopclosure``."""

import sys

from netspec.terminal.main import program


def main() -> int:
    """Run one command of loopclosure."""
    return program("loopclosure.cli")


if __name__ == "__main__":
    sys.exit(main())

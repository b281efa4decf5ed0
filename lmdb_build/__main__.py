"""The program ``lmdb-build``, and ``python -m lmdb_build``."""

import sys

from netspec.terminal.main import program


def main() -> int:
    """Run one command of lmdb-build."""
    return program("lmdb_build.cli")


if __name__ == "__main__":
    sys.exit(main())

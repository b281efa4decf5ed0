"""The program ``lmdb-build``, and ``python -m lmdb_build``."""

import os
import sys
from functools import partial

# python -m puts the working directory first in sys.path, so that a file torch.py there would be imported. It stays only
# if the package itself is there.
HERE = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
if __name__ == "__main__" and sys.path[:1] == [os.getcwd()] != [HERE] and not getattr(sys.flags, "safe_path", False):
    del sys.path[0]

from netspec.terminal.main import program  # noqa: E402

main = partial(program, "lmdb_build.cli")

if __name__ == "__main__":
    sys.exit(main())

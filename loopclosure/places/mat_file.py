"""Reads MATLAB files in a separate process, because a damaged file can crash SciPy's reader.

Run as a program, this file writes the matrices of a .mat file to standard output, as .npz.
"""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path
from typing import Any

# The process may use this much memory beyond what it starts with: LIMIT bytes plus TIMES the size of the file.
LIMIT = 1 << 30
TIMES = 100


def read_mat(path: str | Path) -> dict[str, Any]:
    """Return the matrices (M, N) of numbers in a .mat file, by name. Raises InputError for any other file."""
    from loopclosure.errors import InputError
    from netspec.files.arrays import unpack

    done = subprocess.run([sys.executable, __file__, str(path)], capture_output=True, check=False)
    if done.returncode:
        messages = done.stderr.decode(errors="replace").strip().splitlines()
        reason = messages[-1] if messages and done.returncode == 1 else "the reader crashed"
        raise InputError(f"cannot be read as .mat ({reason})", path)
    return unpack(io.BytesIO(done.stdout), len(done.stdout))


def _limit_memory(path: str) -> None:
    statm = Path("/proc/self/statm")
    if not statm.exists():  # Windows has no such limit, and macOS refuses one below what it has reserved
        return
    import resource

    used = int(statm.read_text("ascii").split()[0]) * resource.getpagesize()
    most = used + LIMIT + TIMES * Path(path).stat().st_size
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (most if hard < 0 else min(most, hard), hard))


def _main(path: str) -> None:
    import numpy as np
    import scipy.io
    import scipy.sparse

    _limit_memory(path)
    matrices = {}
    try:
        for name, found in scipy.io.loadmat(path).items():
            value = found.toarray() if scipy.sparse.issparse(found) else found
            if not name.startswith("__") and isinstance(value, np.ndarray) and value.ndim == 2 and value.size > 1:
                matrices[name] = value if value.dtype.kind in "buif" else np.array(str(value.dtype))
        written = io.BytesIO()
        np.savez(written, allow_pickle=False, **matrices)
    except NotImplementedError:
        sys.exit("it is a MATLAB 7.3 file; save it again in MATLAB with -v7")
    except BaseException as error:  # loadmat can raise anything for a damaged file
        sys.exit(" ".join(str(error).split()) or type(error).__name__)
    sys.stdout.buffer.write(written.getvalue())


if __name__ == "__main__":
    sys.path.pop(0)  # no modules are imported from the folder of this file
    _main(sys.argv[1])

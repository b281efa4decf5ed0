# Sourced by the scripts of tools/: makes a Python environment, .venv in this project, and installs into it, once.
# NEEDS: the extras of pyproject.toml that a script needs; without it, only the dependencies of the programs are installed.
# VENV: another environment, which may exist already; a torch in it is kept. PYTHON: the Python to make it with.
# pip's own variables, such as PIP_EXTRA_INDEX_URL, apply.
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
VENV="${VENV:-$ROOT/.venv}"
PYTHON="${PYTHON:-python3}"
NEEDS="${NEEDS:-}"
INSTALLED="$VENV/installed${NEEDS:+-$NEEDS}"
if [ ! -x "$VENV/bin/netspec" ] || [ ! -e "$INSTALLED" ] || [ "$ROOT/pyproject.toml" -nt "$INSTALLED" ]; then
  quiet=--quiet
  if [ -t 2 ]; then quiet=; fi  # on a terminal pip shows how long a download takes
  # pip unpacks gigabytes into TMPDIR, and /tmp may be in memory. It compiles nothing: Python does so at a
  # module's first import, and most of the 14,000 modules are never imported.
  install() {
    TMPDIR="$VENV/tmp" "$VENV/bin/python" -m pip install $quiet --no-compile --disable-pip-version-check "$@" >&2
  }
  if ! "$VENV/bin/python" -m pip --version >/dev/null 2>&1; then
    if ! "$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 10))'; then
      echo "$("$PYTHON" --version) is too old; name Python 3.10 or later: PYTHON=python3.12 $0" >&2
      exit 1
    fi
    "$PYTHON" -m venv "$VENV"
  fi
  mkdir -p "$VENV/tmp"
  if "$VENV/bin/python" -c 'import torch' 2>/dev/null; then
    echo "Installing into $VENV, once. The PyTorch in it is kept" >&2
  else
    echo "Installing into $VENV, once. This takes minutes and, on Linux, 5.2 GB, most of it for NVIDIA GPUs." >&2
    echo "With PyTorch for the CPU alone it takes 1.5 GB: see docs/start.md" >&2
    install -c "$ROOT/constraints.txt" torch
  fi
  echo "Installing everything else" >&2
  install -e "$ROOT${NEEDS:+[$NEEDS]}"
  rm -r "$VENV/tmp"
  touch "$VENV/installed" "$INSTALLED"
fi
"$PYTHON" "$ROOT/prototxt/variants.py"
export PATH="$VENV/bin:$PATH"

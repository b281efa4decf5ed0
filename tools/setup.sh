# Sourced by the scripts of tools/: makes a Python environment by tools/install.py, which describes VENV and NEEDS.
# PYTHON: the Python to make it with.
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
VENV="${VENV:-$ROOT/.venv}"
PYTHON="${PYTHON:-python3}"
# For this one command: what a script starts later, such as a test of the quick start, may install elsewhere.
VENV="$VENV" NEEDS="${NEEDS:-}" "$PYTHON" "$ROOT/tools/install.py"
export PATH="$VENV/bin:$PATH"

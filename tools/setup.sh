# Sourced by the scripts of tools/: makes a Python environment by tools/install.py, which describes VENV and NEEDS.
# PYTHON: the Python to make it with.
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
export VENV="${VENV:-$ROOT/.venv}" NEEDS="${NEEDS:-}"
PYTHON="${PYTHON:-python3}"
"$PYTHON" "$ROOT/tools/install.py"
export PATH="$VENV/bin:$PATH"

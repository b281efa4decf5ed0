# Sourced by tools/quickstart and tools/run_tests: makes .venv in this project and installs into it, once.
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
VENV="${VENV:-$ROOT/.venv}"
if [ ! -x "$VENV/bin/netspec" ] || [ "$ROOT/pyproject.toml" -nt "$VENV/installed" ]; then
  echo "Installing into $VENV ..." >&2
  "${PYTHON:-python3}" -m venv "$VENV"
  "$VENV/bin/python" -m pip install --quiet --disable-pip-version-check -c "$ROOT/constraints.txt" -e "$ROOT[dev]"
  touch "$VENV/installed"
fi
export PATH="$VENV/bin:$PATH"

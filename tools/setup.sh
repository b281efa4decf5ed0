# Sourced by the scripts of tools/: makes .venv in this project and installs into it, once. NEEDS names the extras
# of pyproject.toml that a script needs; without it only what the programs themselves need is installed.
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
VENV="${VENV:-$ROOT/.venv}"
NEEDS="${NEEDS:-}"
INSTALLED="$VENV/installed${NEEDS:+-$NEEDS}"
if [ ! -x "$VENV/bin/netspec" ] || [ ! -e "$INSTALLED" ] || [ "$ROOT/pyproject.toml" -nt "$INSTALLED" ]; then
  quiet=--quiet
  if [ -t 2 ]; then quiet=; fi  # on a terminal pip shows how long a download takes
  install() { "$VENV/bin/python" -m pip install $quiet --disable-pip-version-check -c "$ROOT/constraints.txt" "$@" >&2; }
  echo "Installing into $VENV, once: about $([ "$NEEDS" ] && echo 2 || echo 1.5) GB on disk" >&2
  "${PYTHON:-python3}" -m venv "$VENV"
  echo "1 of 2: PyTorch, which is most of it; a few minutes" >&2
  install torch
  echo "2 of 2: everything else" >&2
  install -e "$ROOT${NEEDS:+[$NEEDS]}"
  touch "$VENV/installed" "$INSTALLED"
fi
"${PYTHON:-python3}" "$ROOT/prototxt/variants.py"
export PATH="$VENV/bin:$PATH"

"""The packages that this project needs: permissive licenses and compatible versions."""

import re
import subprocess
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution

import pytest

PROJECT = "netspec-caffe"
# Licenses that let programs of any license be built on a package.
PERMISSIVE = (
    r"MIT|BSD|0BSD|Apache|PSF|Python Software Foundation|OLDAP|OpenLDAP|Zlib|CC0|MPL-2\.0|Mozilla|HPND|ISC|BSL|EPL-2\.0"
)
RESTRICTED = r"\b(A?GPL|GNU (Affero )?General Public|SSPL|CC-BY-NC|Commercial|Proprietary)"
# Has an exception for programs that use it: the run-time libraries of GCC, in the wheels of NumPy and SciPy.
EXCEPTED = r"GPL-3\.0-or-later WITH GCC-exception-3\.1"
# NVIDIA's libraries have terms of their own. They come with torch's build for Linux, and docs/licenses.md says so.
NVIDIAS = re.compile(r"nvidia-|cuda-")
NAME = re.compile(r"[A-Za-z0-9._-]+")


def requirements(name: str) -> dict[str, Distribution]:
    """Return what a package needs without extras, and what that needs, as far as it is installed."""
    found: dict[str, Distribution] = {}
    wanted = [name]
    while wanted:
        asked = wanted.pop()
        key = re.sub(r"[-_.]+", "-", asked).lower()
        if key in found:
            continue
        try:
            found[key] = distribution(asked)
        except PackageNotFoundError:  # for another system or Python
            continue
        for line in found[key].requires or []:
            if "extra ==" not in line and (match := NAME.match(line)):
                wanted.append(match[0])
    return found


def license_of(package: Distribution) -> str:
    """Return what a package says of its license: its expression, else its classifiers, else the first line of text."""
    meta = package.metadata
    lines = {name: meta.get_all(name, []) for name in ("License-Expression", "Classifier", "License")}
    classified = [line.rpartition(" :: ")[2] for line in lines["Classifier"] if line.startswith("License")]
    said = "; ".join(lines["License-Expression"] or classified or lines["License"]).strip()
    return said.splitlines()[0] if said else ""


def is_permissive(said: str) -> bool:
    said = re.sub(EXCEPTED, "", said)
    return re.search(PERMISSIVE, said) is not None and re.search(RESTRICTED, said) is None


def test_dependencies_have_permissive_licenses() -> None:
    packages = requirements(PROJECT)
    assert {"torch", "numpy", "scipy", "lmdb", "pillow"} <= set(packages)
    others = {name: said for name, package in packages.items() if not is_permissive(said := license_of(package))}
    assert {name: said for name, said in others.items() if not NVIDIAS.match(name)} == {}
    bring = {name for name, package in packages.items() if any(map(NVIDIAS.match, package.requires or []))}
    assert {name for name in bring if not NVIDIAS.match(name)} <= {"torch"}


@pytest.mark.parametrize("said", ["GPL-3.0-only", "GNU General Public License", "MIT AND AGPL-3.0", "", "Proprietary"])
def test_restrictive_and_missing_licenses_are_not_permissive(said: str) -> None:
    assert not is_permissive(said)


@pytest.mark.slow
def test_pip_check_finds_no_conflict_of_our_dependencies() -> None:
    done = subprocess.run([sys.executable, "-m", "pip", "check"], capture_output=True, text=True)
    if "No module named pip" in done.stderr:
        pytest.skip("installed without pip")
    ours = [line for line in done.stdout.lower().splitlines() if line.split()[0] in requirements(PROJECT)]
    assert ours == []

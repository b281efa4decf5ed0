"""The included nets, by name, as describers for a loop-closure detector.

Their only source is ``prototxt/``: building the wheel copies it into this package (setup.py). In an editable
installation or a checkout, it is next to the package. The entry points ``loopclosure.describers`` in pyproject.toml
name the functions of this module. To change a net, change :data:`DEFAULT` or :data:`SMALL`; setup.py then copies
the new one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from netspec.errors import SpecError

# Folders of prototxt/ with deploy.prototxt and NAME.caffemodel, NAME that of the folder, SOURCE.md and perhaps LICENSE.
DEFAULT = "many_negatives/places"
SMALL = "many_negatives/siamese_words_256"


def folder(net: str = "") -> Path:
    """Return the folder of an included net: ``siamese_8``, or one in a folder of ``prototxt/``."""
    package = Path(__file__).parents[2]
    for nets in (package / "prototxt", package.parent / "prototxt"):
        if (nets / net).is_dir():
            return nets / net
    raise SpecError(f'the net "{net}" is not installed; expected {package / "prototxt" / net}')


def default(**options: Any) -> Any:
    """Return the recommended net as a :class:`~netspec.inspect.features.describer.Describer` with these keywords.

    Without ``engine``, the fastest installed engine runs it.
    """
    return _describer(DEFAULT, options)


def small(**options: Any) -> Any:
    """Return the net for small computers, as a Describer with these keywords."""
    return _describer(SMALL, options)


def _describer(net: str, options: dict[str, Any]) -> Any:
    # setup.py reads this file without these packages.
    from netspec.export.engines.choice import fastest
    from netspec.inspect.features.describer import Describer

    files, options = folder(net), {"engine": fastest(), **options}
    return Describer(files / "deploy.prototxt", files / f"{files.name}.caffemodel", **options)

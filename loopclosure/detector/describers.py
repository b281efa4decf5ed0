"""The functions that describe images: included nets, those of installed packages, and the user's own."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
import sys
from pathlib import Path
from typing import Any, cast

from loopclosure.detector.saved import Describe
from loopclosure.errors import InputError

DESCRIBERS = "loopclosure.describers"  # the group of entry points: name -> function that makes a describer
NAME = r"[\w-]+"  # the form of a name in that group
OWN = ("netspec", "loopclosure", "lmdb_build")  # one distribution; a checkout of it may be the working directory


def load_describe(specification: str, options: dict[str, str] | None = None) -> Describe:
    """Return the ``describe`` function that ``module:name`` or ``FILE.py:name`` names, or a name without a colon.

    A name without a colon is an entry point in the group ``loopclosure.describers`` of an installed package. It is
    always called with ``options``.
    A class, a function if there are options, and a function that cannot take one image are called with ``options`` as
    keywords and must return the ``describe`` function.
    A module must belong to an installed package; a file in the working directory runs only if its path is given.
    """
    options = options or {}
    if re.fullmatch(NAME, specification):
        return _called(_entry_point(specification), specification, options)
    module_name, colon, name = specification.rpartition(":")
    if not colon or not name or not module_name:
        raise InputError(f'"{specification}" does not name a function; expected module:function or FILE.py:function')
    try:
        target: Any = _file_module(Path(module_name)) if module_name.endswith(".py") else _installed_module(module_name)
    except (ImportError, SyntaxError, OSError) as error:
        raise InputError(f'cannot import "{module_name}" of --describe {specification}: {error}') from error
    for part in name.split("."):
        if not hasattr(target, part):
            raise InputError(f'"{module_name}" has no "{name}" (--describe {specification})')
        target = getattr(target, part)
    if options or isinstance(target, type) or not _takes_an_image(_callable(target, specification)):
        return _called(target, specification, options)
    return _callable(target, specification)


def _takes_an_image(function: Describe) -> bool:
    """Return whether a function can be called with one argument; True where that is not known."""
    try:
        inspect.signature(function).bind(None)
    except TypeError:
        return False
    except ValueError:  # a function in C may have no signature
        return True
    return True


def _called(target: Any, specification: str, options: dict[str, str]) -> Describe:
    try:
        return _callable(target(**{key: _value(text) for key, text in options.items()}), specification)
    except (TypeError, ValueError, OSError) as error:
        raise InputError(f"--describe {specification}: {error}") from error


def _callable(target: Any, specification: str) -> Describe:
    if not callable(target):
        raise InputError(f"--describe {specification} is a {type(target).__name__}, which cannot be called")
    return cast(Describe, target)


def _entry_point(name: str) -> Any:
    # Imported here, since detectors with another function do not need it.
    from importlib.metadata import entry_points

    found = entry_points(group=DESCRIBERS)
    if name not in found.names:
        known = ", ".join(sorted(found.names)) or "none is installed: install the package again (pip install)"
        raise InputError(f'no describer has the name "{name}"; expected module:function, or a name ({known})')
    try:
        return found[name].load()
    except (ImportError, AttributeError) as error:
        raise InputError(f"--describe {name}: {found[name].value} cannot be imported: {error}") from error


def _installed_module(name: str) -> Any:
    here, top = Path.cwd(), name.partition(".")[0]
    found = importlib.util.find_spec(top)
    origins = [] if found is None else [found.origin, *(found.submodule_search_locations or ())]
    near = [here / f"{top}.py", here / top / "__init__.py", here / top]
    lies_here = any(origin and Path(origin) in near for origin in origins)
    if top not in OWN and (lies_here or (found is None and any(path.exists() for path in near))):
        path = "/".join(name.split(".")) + ".py"
        raise InputError(
            f'"{name}" lies in the working directory, not in an installed package; name its file: ./{path}'
        )
    return importlib.import_module(name)


def _file_module(path: Path) -> Any:
    """Run a file as a module. Its folder is searched for imports after the installed packages."""
    spec = importlib.util.spec_from_file_location(f"_describe_{path.stem}", path)
    assert spec is not None, "the path ends in .py"
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    sys.path.append(str(path.resolve().parent))
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(path.resolve().parent))
    return module


def _value(text: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text

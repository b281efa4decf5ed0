"""The methods by name, as the command line writes them.

``thumbnails``, ``features:FILE`` or ``describe:FUNCTION``; a method that refines the scores of another is written
before it: ``verified+seqslam+features:siamese.npz``. Settings are given apart, as ``verified.k=20``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

from loopclosure.errors import InputError
from loopclosure.methods import auto, baselines, described, features, seqslam, verified
from loopclosure.methods.base import Method, MethodContext
from netspec.errors import did_you_mean, printable

# The settings of this method, the context, the inner method (None for a method that refines no other).
Factory = Callable[[Mapping[str, str], MethodContext, Method | None], Method]
METHODS: dict[str, Factory] = {
    "fabmap": baselines.fabmap,
    "bow": baselines.bag_of_words,
    "thumbnails": baselines.thumbnails,
    "seqslam": seqslam.seqslam,
    "features": features.features,
    "describe": described.described,
    "verified": verified.verified,
    "auto": auto.auto,
}
REFINERS = ("seqslam", "verified", "auto")
# What follows the colon of these methods is this setting.
OF_NAME = {"features": "file", "describe": "function"}


def named_methods(
    texts: Sequence[str], context: MethodContext | None = None, settings: Mapping[str, str] | None = None
) -> list[tuple[str, Method]]:
    """Build methods from ``[LABEL=]METHOD``; return for each the name to show, and the method.

    settings  ``NAME.setting`` -> value, where NAME is a method or a label; those of a label are for its outermost
              method, and come before those of the method

    Raises InputError for an unknown method or setting, and for settings of a NAME that is not in ``texts``.
    """
    given: dict[str, dict[str, str]] = {}
    for key, value in (settings or {}).items():
        name, dot, setting = key.rpartition(".")
        if not dot:
            raise InputError(f'"{key}={value}": expected NAME.setting=value, as in verified.k=20')
        given.setdefault(name, {})[setting] = value
    used: set[str] = set()
    methods = []
    for text in texts:
        label, equals, spec = text.partition("=")
        if not equals or ":" in label:  # this = is part of a path
            label, spec = "", text
        method = _built(spec, context or MethodContext(), given, given.get(label, {}) if label else {}, used)
        used.add(label)
        methods.append((printable(label.strip()) or method.name, method))
    for name in given.keys() - used:
        raise InputError(f'settings of "{name}", which is none of the methods{did_you_mean(name, sorted(used))}')
    return methods


def make_method(text: str, context: MethodContext | None = None, settings: Mapping[str, str] | None = None) -> Method:
    """Build one method; see :func:`named_methods`."""
    ((_, method),) = named_methods([text], context, settings)
    return method


def _built(
    spec: str, context: MethodContext, given: Mapping[str, Mapping[str, str]], own: Mapping[str, str], used: set[str]
) -> Method:
    name, sign, rest = re.fullmatch(r"([^:+]*)([:+]?)(.*)", spec, re.DOTALL).groups()  # pyright: ignore
    if name not in METHODS:
        close = did_you_mean(name, list(METHODS)) or f"; known: {', '.join(METHODS)}"
        raise InputError(f'unknown method "{name}" in "{spec}"{close}')
    used.add(name)
    settings, inner = {**given.get(name, {}), **own}, None
    if sign == "+":
        if name not in REFINERS:
            raise InputError(f"{name}+{rest}: {name} works on images, not on the scores of another method")
        inner = _built(rest, context, given, {}, used)
    elif sign:
        if name not in OF_NAME:
            raise InputError(f'"{spec}": settings are given apart, as {name}.setting=value (--set)')
        settings[OF_NAME[name]] = rest
    return METHODS[name](settings, context, inner)

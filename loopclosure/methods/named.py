"""The methods by name. On the command line a method is written name[:argument].

A method that refines the scores of another is written name[:argument]+METHOD, where METHOD may refine a third one:
verified:k=20+seqslam+features:siamese.npz:cosine.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from loopclosure.errors import InputError
from loopclosure.methods import auto, baselines, described, features, seqslam, verified
from loopclosure.methods.base import Method, MethodContext
from netspec.errors import did_you_mean

# The argument after the colon, the context, the inner method (None for a method that refines no other).
Factory = Callable[[str, MethodContext, Method | None], Method]
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


def make_method(spec: str, context: MethodContext | None = None) -> Method:
    """Build a method from a specification such as ``seqslam+features:siamese.npz``."""
    context = context or MethodContext()
    name = re.split("[:+]", spec, maxsplit=1)[0]
    if name not in METHODS:
        close = did_you_mean(name, list(METHODS)) or f"; known: {', '.join(METHODS)}"
        raise InputError(f'unknown method "{name}" in "{spec}"{close}')
    argument, inner = spec[len(name) :], None
    if name in REFINERS or argument.startswith("+"):
        # A path may contain "+"; a method begins where its name follows.
        begins = re.search(rf"\+(?=({'|'.join(METHODS)})([:+]|$))|^\+", argument)
        if begins:
            argument, inner_spec = argument[: begins.start()], argument[begins.end() :]
            inner = make_method(inner_spec, context)
    if inner is not None and name not in REFINERS:
        raise InputError(f"{name}+{inner.name}: {name} works on images, not on the scores of another method")
    return METHODS[name](argument.removeprefix(":"), context, inner)

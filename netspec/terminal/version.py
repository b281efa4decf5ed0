"""The version of this installation."""

from __future__ import annotations

import importlib.metadata

DISTRIBUTION = "netspec-caffe"
UNKNOWN = "unknown"


def version(distribution: str = DISTRIBUTION) -> str:
    """Return the version of an installed distribution, "unknown" where it is not installed."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:  # the source is used without being installed
        return UNKNOWN

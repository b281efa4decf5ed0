"""Makes labeled pairs from image sequences, and databases for Data layers from pairs.

The public names are loaded when they are first used: until ``python -m lmdb_build`` has removed the working directory
from Python's path, this file must import nothing.
"""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from lmdb_build.databases import DatumOptions, image_key, pair_key, read_pairs, read_single_list, write_databases
    from lmdb_build.pairs.build import Plan, build_lists
    from lmdb_build.pairs.by_pose import PoseRule, PoseSource, Scenes
    from lmdb_build.pairs.list_file import read_pair_list, write_pair_list

_HOMES = ("databases", "pairs.build", "pairs.by_pose", "pairs.list_file")
__all__ = [
    "DatumOptions",
    "Plan",
    "PoseRule",
    "PoseSource",
    "Scenes",
    "build_lists",
    "image_key",
    "pair_key",
    "read_pair_list",
    "read_pairs",
    "read_single_list",
    "write_databases",
    "write_pair_list",
]


def __getattr__(name: str) -> "Any":
    if name not in __all__:
        raise AttributeError(f"module 'lmdb_build' has no attribute {name!r}")
    from importlib import import_module

    homes = (import_module(f"lmdb_build.{home}") for home in _HOMES)
    return next(getattr(home, name) for home in homes if hasattr(home, name))

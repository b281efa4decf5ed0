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

_HOMES = {
    "DatumOptions": "lmdb_build.databases",
    "Plan": "lmdb_build.pairs.build",
    "PoseRule": "lmdb_build.pairs.by_pose",
    "PoseSource": "lmdb_build.pairs.by_pose",
    "Scenes": "lmdb_build.pairs.by_pose",
    "build_lists": "lmdb_build.pairs.build",
    "image_key": "lmdb_build.databases",
    "pair_key": "lmdb_build.databases",
    "read_pair_list": "lmdb_build.pairs.list_file",
    "read_pairs": "lmdb_build.databases",
    "read_single_list": "lmdb_build.databases",
    "write_databases": "lmdb_build.databases",
    "write_pair_list": "lmdb_build.pairs.list_file",
}

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
    if name not in _HOMES:
        raise AttributeError(f"module 'lmdb_build' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)

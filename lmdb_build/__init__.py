"""Makes labeled pairs from image sequences, and databases for Data layers from pairs."""

from lmdb_build.databases import DatumOptions, image_key, pair_key, read_pairs, read_single_list, write_databases
from lmdb_build.pairs.build import Plan, build_lists
from lmdb_build.pairs.by_pose import PoseRule, PoseSource, Scenes
from lmdb_build.pairs.list_file import read_pair_list, write_pair_list

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

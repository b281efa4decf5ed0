"""Folders of families of dialects, as (folder, package). A file of a family that has DECLARATIONS is a dialect."""

import os.path

FOLDERS = [(os.path.abspath(f"{__file__}/../../../dialects"), "netspec.dialects")]

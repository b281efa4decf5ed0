"""Folders whose .py files are dialects, as (folder, package)."""

import os.path

FOLDERS = [(os.path.abspath(f"{__file__}/../../../dialects"), "netspec.dialects")]

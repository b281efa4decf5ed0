"""Folders whose .py files are dialects, as (folder, package); packages add their own.

This module imports nothing, so that adding a folder is fast.
"""

FOLDERS: list[tuple[str, str]] = []

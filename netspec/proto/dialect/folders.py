"""Folders whose .py files are dialects, as (folder, package): whoever has one adds it; the language knows none itself.

Without an import, so that it costs nothing to add one.
"""

FOLDERS: list[tuple[str, str]] = []

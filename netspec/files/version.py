"""The version of this distribution."""


def version() -> str:
    """Return the version of the installed distribution, or "unknown" if the source is used without installing it."""
    from importlib import metadata  # imported here, because it takes long

    try:
        return metadata.version("netspec-caffe")
    except metadata.PackageNotFoundError:
        return "unknown"

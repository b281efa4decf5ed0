"""PNG files that announce more than there is."""


def is_cut_png(data: bytes) -> bool:
    """Return whether data is that of a PNG file with a part that announces more than there is.

    OpenCV makes room for the 4 GiB that a part may announce before it looks at how much there is.
    """
    at = 8 if data.startswith(b"\x89PNG\r\n\x1a\n") else len(data)
    while at < len(data):
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    return at > len(data)

"""Protobuf's wire format, for messages that its own library would not write."""


def field(number: int, contents: bytes) -> bytes:
    """Return a field of bytes: its key, its length and its contents."""
    return _varint(number << 3 | 2) + _varint(len(contents)) + contents


def _varint(number: int) -> bytes:
    written = b""
    while number > 127:
        written += bytes([number & 127 | 128])
        number >>= 7
    return written + bytes([number])

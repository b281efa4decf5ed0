"""The messages of an editor, one after the other, whatever comes between them.

A header without a length that can be meant is passed over to the next one that has it; a message that is too large is
read and thrown away.
"""

from __future__ import annotations

import re
from typing import BinaryIO

MOST_BYTES = 8 << 20  # of a message: a document of a megabyte, escaped
_LENGTH = re.compile(rb"Content-Length: *(\d{1,18})\r?\n\Z", re.IGNORECASE)
_LONGEST_LINE = 1 << 16


class Messages:
    """A stream of bytes that has only whole messages, as ``readline`` and ``read`` of their headers and bodies.

    ``dropped`` counts the messages that were too large.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._body, self._lines = stream, b"", [b""]
        self.dropped = 0

    def readline(self) -> bytes:
        """Return the next line of a header; b"" at the end."""
        self._lines.pop(0)
        if not self._lines:
            self._body = self._next()
            ended = not self._body
            self._lines = [b""] if ended else [b"Content-Length: %d\r\n" % len(self._body), b"\r\n"]
        return self._lines[0]

    def read(self, size: int = -1) -> bytes:
        """Return the body of the message."""
        return self._body

    def _next(self) -> bytes:
        """Return the body of the next message; b"" at the end, which may come in the midst of it."""
        length = 0
        while line := self._stream.readline(_LONGEST_LINE):
            if match := _LENGTH.search(line):
                length = int(match[1])
            elif not line.strip() and length > MOST_BYTES:
                self.dropped += 1
                while length and (part := self._stream.read(min(length, 1 << 20))):
                    length -= len(part)
            elif not line.strip() and length:
                body = self._stream.read(length)
                return body if len(body) == length else b""
        return b""

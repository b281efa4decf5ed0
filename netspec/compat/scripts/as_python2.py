"""Functions for programs translated from Python 2, where Python 3 differs. `--write-py3` copies them from here."""

import builtins
import io
import math
import numbers
from functools import reduce as reduce
from importlib import reload as reload
from sys import intern as intern


def py2_div(left, right):
    """Return left / right, rounded down where both are whole numbers or arrays of them."""
    return left // right if py2_is_whole(left) and py2_is_whole(right) else left / right


def py2_idiv(left, right):
    """Do left /= right as Python 2 does, and return the result; an array is changed in place."""
    if py2_is_whole(left) and py2_is_whole(right):
        left //= right
    else:
        left /= right
    return left


def py2_is_whole(value):
    """Return whether a value is a whole number, or an array of whole numbers."""
    kind = getattr(getattr(value, "dtype", None), "kind", "")
    return kind in "iub" if kind else isinstance(value, numbers.Integral)


def round(number, ndigits=0):
    """Return a number rounded to ``ndigits`` digits, halves away from zero, as a float."""
    scale = 10.0**ndigits
    return math.copysign(math.floor(abs(number) * scale + 0.5) / scale, number)


def cmp(left, right):
    """Return -1, 0 or 1."""
    return (left > right) - (left < right)


def py2_bytes(value):
    """Return a text as the bytes of the file or literal that it came from; everything else as it is."""
    return value.encode("utf-8", "surrogateescape") if isinstance(value, str) else value


def py2_text(data):
    """Return bytes as text where they are UTF-8 without control characters, else as bytes that know what text does."""
    head = bytes(data[:65536])
    try:
        head.decode("utf-8")
    except UnicodeDecodeError as fault:
        if len(head) < 65536 or fault.start < len(head) - 4:  # not just a character that was cut
            return Py2Bytes(data)
    control = head.translate(None, bytes(range(32, 256)) + b"\a\b\t\n\v\f\r\x1b")
    return Py2Bytes(data) if control else bytes(data).decode("utf-8", "surrogateescape")


class Py2Bytes(bytes):
    """Bytes that take text where they take bytes, and are shown as text; an element is a number, for libraries."""

    __hash__ = bytes.__hash__

    def __str__(self):
        return self.decode("utf-8", "surrogateescape")

    def __repr__(self):
        return bytes.__repr__(self)[1:]

    def __format__(self, form):
        return format(str(self), form)

    def __radd__(self, left):
        return Py2Bytes(py2_bytes(left) + bytes(self))

    def encode(self, *_):
        """Return the same: these are bytes already."""
        return self

    def _taking_text(own):  # pyright: ignore[reportSelfClsParameterName]
        def method(self, *arguments, **named):
            result = own(  # pyright: ignore
                self, *([*map(py2_bytes, a)] if isinstance(a, list) else py2_bytes(a) for a in arguments), **named
            )
            if isinstance(result, (list, tuple)):
                return type(result)(map(Py2Bytes, result))
            return Py2Bytes(result) if isinstance(result, bytes) else result

        return method

    for _name in dir(bytes):
        if not _name.startswith("_") and _name not in ("decode", "fromhex", "hex", "maketrans"):
            locals()[_name] = _taking_text(getattr(bytes, _name))  # pyright: ignore[reportCallIssue]
    for _name in ("add", "contains", "eq", "ge", "getitem", "gt", "le", "lt", "mul", "ne"):
        locals()[f"__{_name}__"] = _taking_text(getattr(bytes, f"__{_name}__"))  # pyright: ignore
    del _name, _taking_text


class file:
    """A file of bytes, opened in whatever mode: takes text and bytes, and gives text where its content is text."""

    def __init__(self, name, mode="r", buffering=-1):
        mode = mode.replace("U", "").replace("t", "").replace("b", "") or "r"
        self.buffer = builtins.open(name, f"{mode}b", -1 if buffering == 1 else buffering)  # noqa: SIM115
        self.name, self.mode, self.encoding = name, mode, None
        self._at_once = buffering in (0, 1)
        self._form = None

    def __getattr__(self, name):  # seek, tell, flush, close, fileno, ...
        if name == "buffer":
            raise AttributeError(name)
        return getattr(self.buffer, name)

    def _as_text_or_bytes(self, data):
        """Return data as text if the whole file is text, or else as bytes."""
        if self._form is None:
            head = data
            if self.buffer.seekable():
                place = self.buffer.tell()
                self.buffer.seek(0)
                head = self.buffer.read(65536)
                self.buffer.seek(place)
            self._form = str if isinstance(py2_text(head), str) else Py2Bytes
        return data.decode("utf-8", "surrogateescape") if self._form is str else Py2Bytes(data)

    def read(self, size=-1):
        """Return the rest of the file, or at most ``size`` bytes of it."""
        return self._as_text_or_bytes(self.buffer.read(-1 if size is None else size))

    def readline(self, size=-1):
        """Return the next line with its end."""
        return self._as_text_or_bytes(self.buffer.readline(size))

    def readlines(self, hint=-1):
        """Return the remaining lines."""
        return [self._as_text_or_bytes(line) for line in self.buffer.readlines(hint)]

    def write(self, data):
        """Write text or bytes."""
        self.buffer.write(py2_bytes(data))
        if self._at_once:
            self.buffer.flush()

    def writelines(self, lines):
        """Write a sequence of texts or bytes, without adding line ends."""
        for line in lines:
            self.write(line)

    def __iter__(self):
        return self

    xreadlines = __iter__

    def __next__(self):
        return self._as_text_or_bytes(next(self.buffer))

    next = __next__

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.buffer.close()


class StringIO(file):
    """A file in memory: `StringIO.StringIO` and `cStringIO.StringIO`."""

    def __init__(self, data=b""):
        self.buffer = io.BytesIO(py2_bytes(data))
        self._at_once = False

    _form = property(lambda self: str if isinstance(py2_text(self.buffer.getbuffer()), str) else Py2Bytes)

    def getvalue(self):
        """Return the whole content."""
        return self._as_text_or_bytes(self.buffer.getvalue())


def open(name, mode="r", buffering=-1, *arguments, **named):
    """Open a file as Python 2 does; with an encoding or the like as Python 3 does."""
    if arguments or named:
        return builtins.open(name, mode, buffering, *arguments, **named)
    return file(name, mode, buffering)


io.IOBase.register(file)
InputType = OutputType = StringIO

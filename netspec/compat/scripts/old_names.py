"""Restores names that NumPy, SciPy, scikit-image, lmdb, PyYAML and Python have removed, for old scripts.

Only programs that `netspec run` runs get them. Each module gets its missing names when it is imported.
"""

from __future__ import annotations

import collections
import collections.abc
import importlib
import importlib.abc
import inspect
import os
import re
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

from netspec.compat.scripts.operations import TRANSLATED
from netspec.files.paths import relative
from netspec.terminal.output import VARIABLE


def install(also: Mapping[str, Callable[[Any], None]], quiet: bool = False) -> None:
    """Add the names to modules that are imported already, and to others when they are imported.

    ``also`` has functions for further modules; each is called with its module. Unless ``quiet``, one warning says if
    NumPy is too new for old programs, in this process but not in its forks.
    """
    _PATCHES.update(also)
    if not quiet and os.environ.get(VARIABLE, "0") in ("", "0", "1"):
        process = os.getpid()

        def numpy_with_a_warning(np: Any) -> None:
            _numpy(np)
            if os.getpid() == process:
                _warn_if_too_new(np)

        _PATCHES["numpy"] = numpy_with_a_warning
    for name, value in (("clock", time.perf_counter),):
        _give(time, name, value)
    for name in collections.abc.__all__:
        _give(collections, name, getattr(collections.abc, name))
    _give(inspect, "getargspec", lambda function: inspect.getfullargspec(function)[:4])
    for name, patch in _PATCHES.items():
        if name in sys.modules:
            patch(sys.modules[name])
    sys.meta_path.insert(0, _Finder())


class _Finder(importlib.abc.MetaPathFinder):
    """Finds the modules to patch with Python's finders; and scipy.misc, even if SciPy no longer has it."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        if fullname not in _PATCHES:
            return None
        spec = PathFinder.find_spec(fullname, path)
        if spec is not None and spec.loader is not None:
            spec.loader = _Patched(spec.loader)
            return spec
        return ModuleSpec(fullname, _Patched(None)) if fullname == "scipy.misc" else None


class _Patched(importlib.abc.Loader):
    """A module's own loader, and a patch after it."""

    def __init__(self, own: Any) -> None:
        self.own = own

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self.own.create_module(spec) if self.own else None

    def exec_module(self, module: ModuleType) -> None:
        if self.own:
            self.own.exec_module(module)
        _PATCHES[module.__name__](module)

    def __getattr__(self, name: str) -> Any:  # get_source and others
        if name == "own":
            raise AttributeError(name)
        return getattr(self.own, name)


def _give(module: Any, name: str, value: Any) -> None:
    if name not in vars(module):
        setattr(module, name, value)


# ---- NumPy ----


def _numpy(np: Any) -> None:
    for name, value in (("bool", bool), ("int", int), ("float", float), ("complex", complex), ("object", object)):
        _give(np, name, value)
    for name, value in (("str", str), ("unicode", str), ("long", int)):
        _give(np, name, value)
    renamed = {
        **{"float_": "float64", "complex_": "complex128", "string_": "bytes_", "unicode_": "str_"},
        **{"Inf": "inf", "Infinity": "inf", "infty": "inf", "PINF": "inf", "NaN": "nan", "NAN": "nan"},
        **{"product": "prod", "cumproduct": "cumprod", "sometrue": "any", "alltrue": "all", "row_stack": "vstack"},
        **{"round_": "round", "rank": "ndim", "trapz": "trapezoid", "in1d": "isin"},
    }
    for old, new in renamed.items():
        if hasattr(np, new):
            _give(np, old, getattr(np, new))
    _give(np, "NINF", -np.inf)
    _give(np, "asscalar", lambda a: a.item())
    _give(np, "asfarray", lambda a, dtype=np.float64: np.asarray(a, dtype))
    _give(np, "typeDict", getattr(np, "sctypeDict", {}))
    _give(np, "msort", lambda a: np.sort(a, axis=0))
    if np.__version__ >= "2":
        np.set_printoptions(legacy="1.25")  # a number is shown as 0.5, not as np.float64(0.5)
        new = {"abs", "bool", "max", "min", "pow", "round"}  # `from numpy import *` left Python's own
        np.__all__ = [name for name in np.__all__ if name not in new]
    np.fromstring = _fromstring(np)
    if hasattr(np, "histogram"):
        np.histogram = _histogram(np.histogram)
    _let_threshold_be_nan(np)


_TOO_NEW = (
    "NumPy {} does not convert an array of one element to a number, as old programs expect; pip install 'numpy<2.4'"
)


def _is_too_new(np: Any) -> bool:
    return tuple(map(int, np.__version__.split(".")[:2])) >= (2, 4)


def _warn_if_too_new(np: Any) -> None:
    if _is_too_new(np):
        print(f"netspec run: warning: {_TOO_NEW.format(np.__version__)}", file=sys.stderr)


def remedy(fault: BaseException) -> str:
    """Return advice for an error that is typical of old programs, or an empty string."""
    text = str(fault)
    frames = reversed(traceback.extract_tb(fault.__traceback__))
    frame = next((each for each in frames if each.filename in TRANSLATED), None)
    if frame and (advice := _advice_for_python2(fault, text)):
        return f"{frame.filename}:{frame.lineno} is Python 2 code that cannot be translated: {advice}"
    np = sys.modules.get("numpy")
    one_element = "only 0-dimensional arrays can be converted", "setting an array element with a sequence"
    if np and _is_too_new(np) and text.startswith(one_element):
        return _TOO_NEW.format(np.__version__)
    if unknown := re.search(r'has no (?:field named )?"(\w+)"', text):
        additions = importlib.import_module("netspec.proto.forks").forks().additions()
        return additions.advise(unknown[1], additions.with_field(unknown[1]))
    caffe = sys.modules.get("netspec.compat.pycaffe")
    if isinstance(fault, FileNotFoundError) and caffe and isinstance(fault.filename, str):
        name = relative(fault.filename, os.path.dirname(str(caffe.__file__)))
        if not name.startswith(os.pardir):
            return f"this is python/caffe/{name} of Caffe's sources: put a copy at {fault.filename}"
    return ""


# Not "expected str, bytes or os.PathLike object, not NoneType": there, text would do as well.
_OF_BYTES = re.compile(r"bytes(?!.* or )|encod")
_ADVICE = {  # what an error says, and what to write in the line
    "'cmp'": "cmp is gone; write (a > b) - (a < b), and sort with key=functools.cmp_to_key(function)",
    "sort() takes": "write sort(key=functools.cmp_to_key(function))",
    "sorted expected": "write sorted(values, key=functools.cmp_to_key(function))",
    "not supported between instances": "different types have no order; compare with None first, or convert",
    "'bytes' object has no attribute 'encode'": "write codecs.encode(data, 'base64'), or leave out .encode",
    "'str' object has no attribute 'decode'": "text is decoded already; leave out .decode",
    "slice indices": "write int(x) for a number with a point",
    "single integer": "write int(x) for a number with a point",
    "as an integer": "write int(x) for a number with a point",
    "slices, not float": "write int(x) for a number with a point",
    "only integers, slices": "write int(x) for a number with a point",  # an IndexError of NumPy
    "__format__": "write str(x) for what is formatted",
}


def _advice_for_python2(fault: BaseException, text: str) -> str:
    """Return what to write instead of the code that raised an error; "" for errors of other kinds."""
    if isinstance(fault, (AttributeError, IndexError, NameError, TypeError)):
        for said, advice in _ADVICE.items():
            if said in text:
                return advice
    if isinstance(fault, UnicodeError) or (isinstance(fault, TypeError) and _OF_BYTES.search(text)):
        return "text and bytes differ; write text.encode() for bytes, data.decode() for text, b'...' for a literal"
    return ""


def _let_threshold_be_nan(np: Any) -> None:
    """Let set_printoptions(threshold="nan") mean that arrays are printed whole."""
    new = np.set_printoptions

    def set_printoptions(precision: Any = None, threshold: Any = None, *arguments: Any, **named: Any) -> None:
        whole = threshold == "nan" or threshold != threshold
        new(precision, sys.maxsize if whole else threshold, *arguments, **named)

    np.set_printoptions = set_printoptions


def _fromstring(np: Any) -> Callable[..., Any]:
    text = np.fromstring

    def fromstring(string: Any, dtype: Any = float, count: int = -1, *, sep: str = "", **named: Any) -> Any:
        if sep:
            return text(string, dtype, count, sep=sep, **named)
        return np.frombuffer(string, dtype, count).copy()

    return fromstring


def _histogram(new: Callable[..., Any]) -> Callable[..., Any]:
    """Return numpy.histogram with ``normed``, which is ``density`` now."""

    def histogram(a: Any, bins: Any = 10, range: Any = None, normed: Any = None, *weights: Any, **named: Any) -> Any:
        return new(a, bins, range, named.pop("density", normed), *weights, **named)

    return histogram


def _numpy_random(random: Any) -> None:
    _give(random, "random_integers", lambda low, high=None, size=None: _integers(random, low, high, size))


def _integers(random: Any, low: int, high: int | None, size: Any) -> Any:
    low, high = (1, low) if high is None else (low, high)
    return random.randint(low, high + 1, size)


# ---- SciPy ----


def _scipy_misc(misc: Any) -> None:
    for name, value in (("imread", imread), ("imsave", imsave), ("imresize", imresize), ("toimage", toimage)):
        _give(misc, name, value)
    _give(misc, "bytescale", bytescale)
    _give(misc, "fromimage", lambda image, flatten=False, mode=None: _as_array(image, flatten, mode))
    special = importlib.import_module("scipy.special")
    for name in ("comb", "factorial", "logsumexp"):
        _give(misc, name, getattr(special, name))


def imread(name: Any, flatten: bool = False, mode: str | None = None) -> Any:
    """Return an image file as an array, (H, W) or (H, W, 3 or 4) uint8; with ``flatten`` as gray float32."""
    from PIL import Image

    with Image.open(name) as image:
        return _as_array(image, flatten, mode)


def imsave(name: Any, arr: Any, format: str | None = None) -> None:
    """Write an array as an image; other types than uint8 are scaled from their least and greatest value to 0..255."""
    toimage(arr).save(name, format)


def imresize(arr: Any, size: Any, interp: str = "bilinear", mode: str | None = None) -> Any:
    """Return an image in another size: per cent (int), a factor (float), or (height, width); always uint8."""
    import numpy as np
    from PIL import Image

    image = toimage(arr, mode=mode)
    if isinstance(size, (int, np.integer)):
        new = tuple(int(extent * (size / 100.0)) for extent in image.size)
    elif isinstance(size, (float, np.floating)):
        new = tuple((np.array(image.size) * size).astype(int))
    else:
        new = int(size[1]), int(size[0])
    return np.array(image.resize(new, getattr(Image.Resampling, {"cubic": "bicubic"}.get(interp, interp).upper())))


def toimage(arr: Any, high: int = 255, low: int = 0, cmin: Any = None, cmax: Any = None, mode: Any = None) -> Any:
    """Return an array (H, W), (H, W, 3), (H, W, 4) or with channels first as an image of PIL."""
    import numpy as np
    from PIL import Image

    values = np.asarray(arr)
    if mode == "F":
        return Image.fromarray(values.astype(np.float32))
    if values.ndim == 3 and values.shape[2] not in (3, 4) and values.shape[0] in (3, 4):
        values = values.transpose(1, 2, 0)
    image = Image.fromarray(bytescale(values, cmin, cmax, high, low))
    return image.convert(mode) if mode else image


def bytescale(data: Any, cmin: Any = None, cmax: Any = None, high: int = 255, low: int = 0) -> Any:
    """Return uint8: as it is, or scaled from ``cmin``..``cmax`` (the least and greatest value) to ``low``..``high``."""
    import numpy as np

    values = np.asarray(data)
    if values.dtype == np.uint8:
        return values
    least = values.min() if cmin is None else cmin
    span = (values.max() if cmax is None else cmax) - least
    scaled = (values - least) * ((high - low) / (span or 1)) + low
    return (np.clip(scaled, low, high) + 0.5).astype(np.uint8)


def _as_array(image: Any, flatten: bool, mode: str | None) -> Any:
    import numpy as np

    if mode:
        image = image.convert(mode)
    elif image.mode == "P":
        image = image.convert("RGBA" if "transparency" in image.info else "RGB")
    elif image.mode == "1":
        image = image.convert("L")
    return np.array(image.convert("F")) if flatten else np.array(image)


# ---- scikit-image ----


def _skimage_io(io: Any) -> None:
    new = io.imread
    if "as_grey" in inspect.signature(new).parameters:
        return

    def imread(fname: Any, as_gray: bool = False, *arguments: Any, as_grey: bool = False, **named: Any) -> Any:
        return new(fname, as_gray or as_grey, *arguments, **named)

    io.imread = imread


def _skimage_transform(transform: Any) -> None:
    """Take the last axis of an image (H, W, C) for its channels by default, as until scikit-image 0.19."""
    new = transform.rescale

    def rescale(image: Any, scale: Any, *arguments: Any, multichannel: Any = None, **named: Any) -> Any:
        by_channel = image.ndim == 3 if multichannel is None else multichannel
        return new(image, scale, *arguments, **{"channel_axis": -1 if by_channel else None, **named})

    transform.rescale = rescale


def _skimage_color(color: Any) -> None:
    for old, new in (("rgb2grey", "rgb2gray"), ("grey2rgb", "gray2rgb"), ("gray2rgb", "gray2rgb")):
        _give(color, old, getattr(color, new))


# ---- lmdb ----


def _lmdb(lmdb: Any) -> None:
    """Allow keys to be text, and an environment to be opened twice in a process, as in Python 2."""
    whole, transaction = lmdb.open, lmdb.Transaction
    opened: dict[tuple[int, int], _Environment] = {}

    def open(path: Any, *arguments: Any, **named: Any) -> _Environment:
        earlier = opened.get(_data_file(path))
        if earlier is not None and earlier.users[0]:
            return earlier.again()
        environment = _Environment(whole(path, *arguments, **named))
        opened[_data_file(path)] = environment
        return environment

    def begin(env: Any, *arguments: Any, **named: Any) -> _Transaction:
        return _Transaction(transaction(getattr(env, "real", env), *arguments, **named))

    lmdb.open, lmdb.Environment, lmdb.Transaction = open, open, begin


def _data_file(path: Any) -> tuple[int, int]:
    """Return which file, by device and number, has the data of an environment; (0, 0) if there is none yet."""
    file = os.path.join(path, "data.mdb") if os.path.isdir(path) else path
    try:
        found = os.stat(file)
    except OSError:
        return 0, 0
    return found.st_dev, found.st_ino


class _Proxy:
    """Passes everything on to an object of lmdb, because the classes of lmdb cannot be subclassed."""

    def __init__(self, real: Any) -> None:
        self.real = real

    def __getattr__(self, name: str) -> Any:
        return getattr(self.real, name)

    def __enter__(self) -> Any:
        self.real.__enter__()
        return self

    def __exit__(self, *fault: Any) -> Any:
        return self.real.__exit__(*fault)


class _Environment(_Proxy):
    def __init__(self, real: Any, users: list[int] | None = None) -> None:
        super().__init__(real)
        self.users = users or [0]  # how many have it open, shared by them
        self.users[0] += 1
        self.is_open = True

    def again(self) -> _Environment:
        return _Environment(self.real, self.users)

    def close(self) -> None:
        self.users[0] -= self.is_open
        self.is_open = False
        if not self.users[0]:
            self.real.close()

    __del__ = close

    def __exit__(self, *fault: Any) -> None:
        self.close()

    def begin(self, *arguments: Any, **named: Any) -> _Transaction:
        return _Transaction(self.real.begin(*arguments, **named))


class _Transaction(_Proxy):
    def put(self, key: Any, value: Any, *arguments: Any, **named: Any) -> bool:
        return self.real.put(_bytes(key), _bytes(value), *arguments, **named)

    def get(self, key: Any, *arguments: Any, **named: Any) -> Any:
        return self.real.get(_bytes(key), *arguments, **named)

    def delete(self, key: Any, *arguments: Any, **named: Any) -> bool:
        return self.real.delete(_bytes(key), *arguments, **named)


def _bytes(text: Any) -> Any:
    return text.encode() if isinstance(text, str) else text


# ---- Python ----


def _string(string: Any) -> None:
    """Add the functions that became methods, and the old names of letters."""
    methods = "capitalize center count expandtabs find index ljust lower lstrip replace rfind rindex rjust rsplit"
    for name in (*methods.split(), *("rstrip", "split", "strip", "swapcase", "title", "translate", "upper", "zfill")):
        _give(string, name, getattr(str, name))
    _give(string, "join", lambda words, between=" ": between.join(words))
    _give(string, "joinfields", string.join)
    _give(string, "splitfields", string.split)
    _give(string, "maketrans", str.maketrans)
    for name in ("letters", "lowercase", "uppercase"):
        _give(string, name, getattr(string, f"ascii_{name}"))
    for name, kind in (("atof", float), ("atoi", int), ("atol", int)):
        _give(string, name, kind)


def _pickle(pickle: Any) -> None:
    """Allow pickles of Python 2 with any bytes in strings, and files opened as text."""
    load, loads, dump = pickle.load, pickle.loads, pickle.dump
    pickle.load = lambda file, **named: load(getattr(file, "buffer", file), **{"encoding": "latin1", **named})
    pickle.loads = lambda data, **named: loads(data, **{"encoding": "latin1", **named})
    pickle.dump = lambda obj, file, *form, **named: dump(obj, getattr(file, "buffer", file), *form, **named)


def _yaml(yaml: Any) -> None:
    """Make the loader optional: the default is FullLoader, as in PyYAML 5."""
    load, load_all = yaml.load, yaml.load_all
    yaml.load = lambda stream, Loader=yaml.FullLoader: load(stream, Loader)
    yaml.load_all = lambda stream, Loader=yaml.FullLoader: load_all(stream, Loader)


def _unittest_case(case: Any) -> None:
    renamed = {
        **{"assertEquals": "assertEqual", "assertNotEquals": "assertNotEqual", "assert_": "assertTrue"},
        **{"assertAlmostEquals": "assertAlmostEqual", "assertRaisesRegexp": "assertRaisesRegex"},
        **{"assertRegexpMatches": "assertRegex", "assertItemsEqual": "assertCountEqual"},
    }
    for old, new in renamed.items():
        _give(case.TestCase, old, getattr(case.TestCase, new))


_PATCHES: dict[str, Callable[[Any], None]] = {
    "numpy": _numpy,
    "numpy.random": _numpy_random,
    "scipy.misc": _scipy_misc,
    "scipy.ndimage": lambda ndimage: _give(ndimage, "imread", imread),
    "skimage.io": _skimage_io,
    "skimage.color": _skimage_color,
    "skimage.transform": _skimage_transform,
    "lmdb": _lmdb,
    "unittest.case": _unittest_case,
    "string": _string,
    "pickle": _pickle,
    "yaml": _yaml,
}
PACKAGES = frozenset(name.partition(".")[0] for name in _PATCHES)

"""Scripts in Python 2: which are recognized, and that their translation computes what they did."""

import math
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from case_files import read_cases
from netspec.compat.scripts import python2
from netspec.compat.scripts.as_python2 import py2_div, round
from netspec.compat.scripts.python2 import is_python2, translated
from netspec.errors import SpecError
from paths import ROOT

pytestmark = pytest.mark.slow

Run = Callable[..., "subprocess.CompletedProcess[str]"]
ONLY_PYTHON_2 = [
    'print "x"',
    "print",
    "print >>f, 1",
    "try:\n    pass\nexcept ValueError, e:\n    pass",
    "raise ValueError, 'x'",
    "exec 'x = 1'",
    "x = 0777",
    "x = `1`",
    "if 1 <> 2: pass",
    "for i in xrange(3): pass",
    "raw_input()",
    "import cPickle",
    "import urllib2",
    "from StringIO import StringIO",
    "for k, v in d.iteritems(): pass",
    "net.params.has_key('conv1')",
    "sys.maxint",
    "itertools.izip(a, b)",
    "if x:\n\ty = 1\n        z = 2",
    "#!/usr/bin/env python2\nx = 1",
]
ALSO_PYTHON_3 = [
    "print('x')",
    "print('x', file=f)\nfor i in xrange(3): pass",
    "try:\n    import cPickle as pickle\nexcept ImportError:\n    import pickle",
    "try:\n    xrange\nexcept NameError:\n    xrange = range\nfor i in xrange(3): pass",
    "from six.moves import xrange\nxrange(3)",
    "six.iteritems(d)",
    "file = open(name)",
    "def f(long, cmp): return long + cmp",
    "x: int = d.has_key(1)",
    "f'{x}'; d.iteritems()",
    "from __future__ import print_function\nprint('x', file=f)",
    "x = 7 / 2",
]
CASES = read_cases("netspec/compat/scripts/cases/python2.txt")


@pytest.mark.parametrize("source", ONLY_PYTHON_2)
def test_python_2_is_recognized(source: str) -> None:
    assert is_python2(source.encode(), "s.py")
    compile(translated(source.encode(), "s.py"), "s.py", "exec")


@pytest.mark.parametrize("source", [*ALSO_PYTHON_3, "def f(:\n"])  # the last is neither
def test_python_3_is_not_translated(source: str) -> None:
    assert not is_python2(source.encode(), "s.py")


@pytest.mark.parametrize("package", ["fissix", "lib2to3"])
def test_with_either_translator(package: str, monkeypatch: pytest.MonkeyPatch, python: Run) -> None:
    pytest.importorskip(package)
    monkeypatch.setattr(python2, "_translator", lambda: package)
    source = (
        f"#{package}\nd = {{'a': 7}}\nfor k, v in d.iteritems(): print k, v/2,\nx = 3; x /= 2\nprint x, x/2.0, -x*5/2"
    )
    assert python("-c", translated(source.encode(), "s.py", alone=True)).stdout == "a 3 1 0.5 -3\n"


def test_without_a_translator_one_line_gives_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(python2, "_translator", lambda: "")
    assert is_python2(b"#none\nprint 'x'", "s.py")
    with pytest.raises(SpecError, match=r"^s\.py: this is Python 2, .* pip install fissix, or "):
        translated(b"#none\nprint 'x'", "s.py")


def test_a_whole_script(run: Run, python: Run, tmp_path: Path) -> None:
    source = CASES["a whole script"]["program"].replace("→", "\t")  # tabs and blanks in one block
    done = run("old.py", files={"old.py": source})
    assert done.stdout.splitlines() == [
        "3 3.5 1.5 4",
        "[0, 0, 1, 1, 2] [0, 0, 0, 0, 1] [0.0, 0.0, 0.5, 0.5, 1.0]",
        "3.0 ['a', 'b'] [1]",
        "3 -4 500.0 0.25 2",
        "2",
    ]
    said = "old.py is Python 2 and was translated to Python 3 to run; --write-py3 FILE writes the translation"
    assert said in done.stderr
    (tmp_path / "binary.txt").unlink()
    written = run("--write-py3", "new.py", "old.py")
    assert (written.stdout, written.stderr) == ("", "")
    assert not (tmp_path / "binary.txt").exists()  # nothing has run
    assert "netspec" not in (tmp_path / "new.py").read_text()
    assert python("new.py", PYTHONPATH="").stdout == done.stdout


@pytest.mark.parametrize("words", [["--shadow-caffe", "s.py"], ["-m", "s"], ["s.py", "argument"]])
def test_options_for_running_are_refused_with_write_py3(words: list[str], run: Run) -> None:
    said = run("--write-py3", "n.py", *words, s="print 1", rc=2).stderr
    assert "--write-py3 translates a script and runs nothing" in said


HALF = "def half(n):\n    return n / 2\n"


def test_modules_next_to_a_python_2_program_are_python_2(run: Run, tmp_path: Path) -> None:
    """Otherwise results would change silently, because these modules are valid in both languages."""
    places = ("bin/beside.py", "bin/pack/below.py", "lib/put.py", "lib/sub/deep.py", "given/elsewhere.py")
    names = ("beside", "pack.below", "put", "sub.deep", "three", "true", "elsewhere")
    program = f"import sys; sys.path.insert(0, 'lib')\nimport {', '.join(names)}\n"
    halves = ", ".join(f"{name}.half(3)" for name in names)
    files = {
        **dict.fromkeys(places, HALF),
        "bin/three.py": "def half(n: int):\n    return n / 2\n",
        "bin/true.py": f"from __future__ import division\n{HALF}",
        "bin/two.py": f"{program}print {halves}",
        "bin/new.py": f"{program}print({halves})",
    }
    expected = {
        ("bin/two.py",): "1 1 1 1 1.5 1.5 1.5\n",
        ("bin/new.py",): "1.5 1.5 1.5 1.5 1.5 1.5 1.5\n",
        ("--python2", "bin/new.py"): "(1, 1, 1, 1, 1.5, 1.5, 1)\n",
    }
    for words, printed in expected.items():
        path = f"{tmp_path / 'given'}{os.pathsep}{ROOT}"
        assert run(*words, files=files, PYTHONPATH=path).stdout == printed


def test_true_division_is_not_translated() -> None:
    text = translated(b"from __future__ import division\nprint 7/2, round(0.5)\n", "s.py")
    assert text == "\nprint(7/2, round(0.5))\n"


def test_a_failed_call_is_not_repeated_and_its_line_is_reported(run: Run) -> None:
    """Otherwise, its effects before the exception would happen twice."""
    program = """import socket
calls = []
def faulty(data):
    calls.append(data)
    raise TypeError("a bytes-like object is required, not 'str'")
class A:
    faulty = staticmethod(faulty)
try:
    A.faulty('x')
except TypeError:
    print calls, reduce(lambda a, b: a + b, [1, 2]), 7 / 2
socket.socketpair()[0].send(u'text')
"""
    done = run("s.py", s=program, rc=1)
    assert done.stdout == "['x'] 3 3\n"
    last = done.stderr.splitlines()[-1]
    assert last.startswith("netspec run: ")
    assert (
        "s.py:12 is Python 2 code that cannot be translated: text and bytes differ; write text.encode() for bytes"
    ) in last


def test_a_python_layer_in_python_2_is_trained(python: Run) -> None:
    layer = """import caffe
class L(caffe.Layer):
    def setup(self, bottom, top):
        print "set up", 7 / 2
    def reshape(self, bottom, top): top[0].reshape(2, 3)
    def forward(self, bottom, top): top[0].data[...] = 1
    def backward(self, top, propagate_down, bottom): pass
"""
    net = """net_param {
      layer { name: "d" type: "Python" top: "x" python_param { module: "lay" layer: "L" } }
      layer { name: "ip" type: "InnerProduct" bottom: "x" top: "y" inner_product_param { num_output: 1 } }
      layer { name: "l" type: "EuclideanLoss" bottom: "y" bottom: "y" top: "l" } }
    base_lr: 0.1 lr_policy: "fixed" max_iter: 1 solver_mode: CPU snapshot_after_train: false"""
    files = {"lay.py": layer, "s.prototxt": net}
    words = ("-m", "netspec", "train", "s.prototxt", "--allow-python-layers")
    assert "translate it with `netspec run --python2 -m netspec train ...`" in python(*words, files=files, rc=1).stderr
    done = python("-m", "netspec", "run", "--python2", *words)
    assert done.stdout == "set up 3\n"
    assert "__main__.py is Python 2" not in done.stderr


def test_a_histogram_accepts_normed(run: Run) -> None:
    s = "import numpy as np\nprint np.histogram([0, 1, 1, 1], bins=2, normed=True)[0].tolist()"
    assert run("s.py", s=s).stdout == "[0.5, 1.5]\n"


def test_modules_of_a_script_are_translated_without_cached_files(run: Run, tmp_path: Path) -> None:
    files = {"helper.py": "def quotient(a, b):\n    print 'dividing'\n    return a / b"}
    done = run("s.py", files=files, s="from helper import quotient\nprint quotient(7, 2)")
    assert done.stdout == "dividing\n3\n"
    assert done.stderr.count("\n") == 2
    assert "helper.py is Python 2 too" in done.stderr
    assert not (tmp_path / "__pycache__").exists()


def test_the_traceback_has_the_translations_lines(run: Run) -> None:
    fault = run("s.py", s="print 1\nraise ValueError, 'bad'", rc=1).stderr
    assert "s.py\", line 2, in <module>\n    raise ValueError('bad')" in fault


def test_python2_forces_the_translation(run: Run) -> None:
    for words, expected in ((["--python2"], "3\n"), ([], "3.5\n")):
        assert run(*words, "s.py", s="print(7 / 2)").stdout == expected


def test_nothing_to_translate_is_reported(run: Run) -> None:
    done = run("--write-py3", "n.py", "s.py", s="print('x')", rc=1)
    assert done.stdout == ""
    assert "s.py: is already Python 3: no translation was written to n.py" in done.stderr


def test_quotients() -> None:
    assert (py2_div(7, 2), py2_div(-7, 2), py2_div(7, 2.0), py2_div(True, 2)) == (3, -4, 3.5, 0)
    assert isinstance(py2_div(np.int64(7), 2), np.integer)
    assert py2_div(np.float32(7), 2) == 3.5
    array = np.arange(4)
    assert py2_div(array, 2).tolist() == [0, 0, 1, 1]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((0.5,), 1.0), ((1.5,), 2.0), ((-0.5,), -1.0), ((2.4,), 2.0), ((3,), 3.0), ((1.25, 1), 1.3),
        ((2.675, 2), 2.67), ((0.49999999999999994,), 0.0), ((math.inf,), math.inf), ((1e300, 10), 1e300),
        ((5000000000000001.0,), 5000000000000001.0), ((1.005, 2), 1.0), ((1234567, -3), 1235000.0), ((1e22, 2), 1e22),
        ((0.285, 2), 0.28), ((4503599627370497.0,), 4503599627370497.0), ((5e-324, 500), 5e-324), ((7.0, -500), 0.0),
    ],
)  # fmt: skip
def test_round_is_that_of_cpython_2(arguments: tuple[Any, ...], expected: float) -> None:
    found = round(*arguments)
    assert isinstance(found, float)
    assert found == expected


def test_round_keeps_nan_and_the_sign_of_zero() -> None:
    assert math.isnan(round(math.nan))
    assert math.copysign(1, round(-0.0)) == -1


@pytest.mark.parametrize(
    ("line", "advice"),
    [
        ("cmp(1, 2)", "write (a > b) - (a < b)"),
        ("[2, 1].sort(lambda a, b: a - b)", "sort(key=functools.cmp_to_key(function))"),
        ("sorted([2, 1], lambda a, b: a - b)", "write sorted(values, key=functools.cmp_to_key(function))"),
        ("None < 1", "compare with None first"),
        ("'a' > 3", "compare with None first, or convert"),
        ("import hashlib; hashlib.md5('a')", "write text.encode() for bytes"),
        ("import struct; struct.unpack('<I', 'abcd')", "write text.encode() for bytes"),
        ("open('s.py', 'rb').read().split('a')", "write text.encode() for bytes"),
        ("'a'.decode('utf-8')", "leave out .decode"),
        ("b'a'.encode('base64')", "write codecs.encode(data, 'base64')"),
        ("import numpy; numpy.zeros(2.0)", "write int(x)"),
        ("range(2.0)", "write int(x)"),
        ("[2, 1][1.0]", "write int(x)"),
        ("import numpy; numpy.zeros(2)[1.0]", "write int(x)"),
        ("'{:4}'.format(None)", "write str(x)"),
    ],
)
def test_what_cannot_be_translated_is_refused_with_its_line(line: str, advice: str, run: Run) -> None:
    last = run("--python2", "s.py", s=f"print 1\n{line}\n", rc=1).stderr.splitlines()[-1]
    assert "s.py:2 is Python 2 code that cannot be translated: " in last
    assert advice in last


@pytest.mark.parametrize("line", ["1 + None", "(lambda a: a)(1, 2)", "len(5)", "[] + ()", "open(None)", "int(None)"])
def test_faults_of_the_program_itself_get_no_advice(line: str, run: Run) -> None:
    assert "cannot be translated" not in run("--python2", "s.py", s=f"print 1\n{line}\n", rc=1).stderr


@pytest.mark.parametrize("case", [name for name, case in CASES.items() if "prints" in case])
def test_programs_print_what_they_did_in_python_2(case: str, run: Run) -> None:
    assert run("--python2", "s.py", s=CASES[case]["program"]).stdout == f"{CASES[case]['prints']}\n"


def test_implicit_relative_imports_work_in_python_2_packages_only(run: Run) -> None:
    files = {
        "main.py": "import settings\nprint settings.X, settings.which",
        "__init__.py": "",
        "settings.py": "import pk.a, pk\nX = pk.a.other.X / 2\nwhich = pk.a.json.mine",
        "pk/__init__.py": "",
        "pk/a.py": "import b as other, json",
        "pk/b.py": "import c.d\nX = c.d.X",
        "pk/json.py": "mine = 1",
        "pk/c/__init__.py": "",
        "pk/c/d.py": "X = 7",
        "new.py": "import pk.a; print(pk.a.other.X)",
    }
    for name, printed in (("main.py", "3 1\n"), ("new.py", "7\n")):
        assert run(name, files=files).stdout == printed


def test_a_translation_keeps_its_files_and_needs_no_netspec(python: Run) -> None:
    source = "import cStringIO\nf = cStringIO.StringIO('ab'); open('o', 'wb').write(f.getvalue())\n"
    text = translated(f"{source}print 7 / 2, len(open('o').read())\n".encode(), "s.py", alone=True)
    assert python("new.py", files={"new.py": text}).stdout == "3 2\n"
    assert "netspec" not in text

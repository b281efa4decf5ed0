"""Scripts in Python 2: which are recognized, and that their translation computes what they did."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from netspec.compat.scripts import python2
from netspec.compat.scripts.as_python2 import cmp, py2_div, py2_idiv, round
from netspec.compat.scripts.python2 import is_python2, translated
from netspec.errors import SpecError
from paths import ROOT

pytestmark = pytest.mark.slow

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


@pytest.mark.parametrize("source", ONLY_PYTHON_2)
def test_python_2_is_recognized(source: str) -> None:
    assert is_python2(source.encode(), "s.py")
    compile(translated(source.encode(), "s.py"), "s.py", "exec")


@pytest.mark.parametrize("source", ALSO_PYTHON_3)
def test_what_runs_as_python_3_is_left_alone(source: str) -> None:
    assert not is_python2(source.encode(), "s.py")


def test_what_is_neither_is_not_python_2() -> None:
    assert not is_python2(b"def f(:\n", "s.py")


@pytest.mark.parametrize("package", ["fissix", "lib2to3"])
def test_with_either_translator(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip(package)
    monkeypatch.setattr(python2, "_translator", lambda: package)
    source = (
        f"#{package}\nd = {{'a': 7}}\nfor k, v in d.iteritems(): print k, v/2,\nx = 3; x /= 2\nprint x, x/2.0, -x*5/2"
    )
    text = translated(source.encode(), "s.py")
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False)
    assert done.stdout == "a 3 1 0.5 -3\n", done.stderr


def test_without_a_translator_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(python2, "_translator", lambda: "")
    assert is_python2(b"#none\nprint 'x'", "s.py")
    with pytest.raises(SpecError, match=r"^s\.py: this is Python 2, .* pip install fissix, or "):
        translated(b"#none\nprint 'x'", "s.py")


SCRIPT = b"""#!/usr/bin/env python
# -*- coding: latin-1 -*-
'''Says \xe9.'''
from __future__ import print_function
import numpy as np
def half(n):
\tif n:
\t    return n/2
        return None
if __name__ == '__main__':
    print(half(7), half(7.), 7 / 2 / 2., 9/(1 + 1))
    a = np.arange(5); b = a
    a /= 2
    print(b.tolist(), (b / 2).tolist(), (b / 2.0).tolist())
    print(round(2.5), sorted({'b': 1, 'a': 2}.keys()), map(half, [2]))
    print(7 // 2, -7 / 2, 1e3/2, 1 / float(4), cmp(1, 2), [1, 2, 3][3/2])
    f = open('binary.txt', 'wb'); f.write('\xff'.encode('latin-1')); f.close()
    print(len(open('binary.txt').read()))
"""


def test_a_whole_script(tmp_path: Path) -> None:
    (tmp_path / "old.py").write_bytes(SCRIPT)
    run = [sys.executable, "-m", "netspec", "run"]
    done = subprocess.run([*run, "old.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        *("3 3.5 1.5 4", "[0, 0, 1, 1, 2] [0, 0, 0, 0, 1] [0.0, 0.0, 0.5, 0.5, 1.0]"),
        *("3.0 ['a', 'b'] [1]", "3 -4 500.0 0.25 -1 2", "1"),
    ]
    said = "old.py is Python 2, and runs translated to Python 3; --write-py3 FILE writes the translation"
    assert said in done.stderr
    (tmp_path / "binary.txt").unlink()
    words = [*run, "--write-py3", "new.py", "old.py"]
    written = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (written.returncode, written.stdout, written.stderr) == (0, "", "")
    assert not (tmp_path / "binary.txt").exists()  # nothing has run
    assert "netspec" not in (tmp_path / "new.py").read_text()
    alone = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [sys.executable, "new.py"]
    again = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, env=alone)
    assert again.stdout == done.stdout, again.stderr


@pytest.mark.parametrize("words", [["--shadow-caffe", "s.py"], ["-m", "s"], ["s.py", "argument"]])
def test_a_translation_that_is_only_written_takes_nothing_for_a_run(words: list[str], tmp_path: Path) -> None:
    (tmp_path / "s.py").write_text("print 1")
    command = [sys.executable, "-m", "netspec", "run", "--write-py3", "n.py", *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, "--write-py3 takes a script, and nothing runs" in done.stderr) == (2, True)


HALF = "def half(n):\n    return n / 2\n"


def test_modules_around_a_program_are_python_2_with_it(tmp_path: Path) -> None:
    """Numbers would be others in silence: nothing in these modules is of one language only."""
    places = ("bin/beside.py", "bin/pack/below.py", "lib/put.py", "lib/sub/deep.py", "given/elsewhere.py")
    for place in places:
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_text(HALF)
    (tmp_path / "bin/three.py").write_text("def half(n: int):\n    return n / 2\n")
    (tmp_path / "bin/true.py").write_text(f"from __future__ import division\n{HALF}")
    program = "import sys; sys.path.insert(0, 'lib')\n"
    program += "import beside, pack.below, put, sub.deep, three, true, elsewhere\n"
    names = ("beside", "pack.below", "put", "sub.deep", "three", "true", "elsewhere")
    halves = ", ".join(f"{name}.half(3)" for name in names)
    (tmp_path / "bin/two.py").write_text(f"{program}print {halves}")
    (tmp_path / "bin/new.py").write_text(f"{program}print({halves})")
    expected = {
        ("two.py",): "1 1 1 1 1.5 1.5 1.5\n",
        ("new.py",): "1.5 1.5 1.5 1.5 1.5 1.5 1.5\n",
        ("new.py", "--python2"): "(1, 1, 1, 1, 1.5, 1.5, 1)\n",
    }
    env = {**os.environ, "PYTHONPATH": f"{tmp_path / 'given'}{os.pathsep}{ROOT}"}
    for (name, *options), printed in expected.items():
        command = [sys.executable, "-m", "netspec", "run", *options, f"bin/{name}"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, env=env)
        assert done.stdout == printed, done.stderr


def test_with_true_division_it_stays(tmp_path: Path) -> None:
    text = translated(b"from __future__ import division\nprint 7/2, round(0.5)\n", "s.py")
    assert "7/2" in text
    assert "from netspec.compat.scripts.as_python2 import round  # as Python 2 has it\n" in text


def test_modules_of_the_script_too_and_nothing_is_left_for_plain_python(tmp_path: Path) -> None:
    (tmp_path / "old.py").write_text("from helper import quotient\nprint quotient(7, 2)")
    (tmp_path / "helper.py").write_text("def quotient(a, b):\n    print 'dividing'\n    return a / b")
    words = [sys.executable, "-m", "netspec", "run", "old.py"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout == "dividing\n3\n", done.stderr
    assert done.stderr.count("\n") == 2
    assert "helper.py is Python 2 too" in done.stderr
    assert not (tmp_path / "__pycache__").exists()


def test_the_traceback_has_the_translations_lines(tmp_path: Path) -> None:
    (tmp_path / "old.py").write_text("print 1\nraise ValueError, 'bad'")
    words = [sys.executable, "-m", "netspec", "run", "old.py"]
    fault = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False).stderr
    assert "old.py\", line 2, in <module>\n    raise ValueError('bad')" in fault


def test_a_script_can_be_said_to_be_python_2(tmp_path: Path) -> None:
    (tmp_path / "old.py").write_text("print(7 / 2)")
    for words, expected in ((["--python2"], "3\n"), ([], "3.5\n")):
        command = [sys.executable, "-m", "netspec", "run", *words, "old.py"]
        assert subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout == expected


def test_nothing_to_translate_is_said(tmp_path: Path) -> None:
    (tmp_path / "new.py").write_text("print('x')")
    command = [sys.executable, "-m", "netspec", "run", "--write-py3", "n.py", "new.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert "new.py: is Python 3 already: there is no translation to write to n.py" in done.stderr


def test_quotients() -> None:
    assert (py2_div(7, 2), py2_div(-7, 2), py2_div(7, 2.0), py2_div(True, 2)) == (3, -4, 3.5, 0)
    assert isinstance(py2_div(np.int64(7), 2), np.integer)
    assert py2_div(np.float32(7), 2) == 3.5
    array = np.arange(4)
    assert py2_div(array, 2).tolist() == [0, 0, 1, 1]
    assert py2_idiv(array, 2) is array
    assert array.tolist() == [0, 0, 1, 1]
    floats = np.ones(2)
    assert py2_idiv(floats, 4) is floats
    assert floats.tolist() == [0.25, 0.25]


def test_rounding_and_comparing() -> None:
    assert [round(x) for x in (0.5, 1.5, -0.5, 2.4)] == [1, 2, -1, 2]
    assert (round(1.25, 1), round(3)) == (1.3, 3.0)
    assert isinstance(round(3), float)
    assert (cmp(1, 2), cmp("b", "a"), cmp(1, 1)) == (-1, 1, 0)


AS_PYTHON_2 = {
    "binary file as text": """
from caffe.proto import caffe_pb2 as c
b = c.BlobProto(data=[-1.0, 2e9])
open('m','w').write(b.SerializeToString())
b.ParseFromString(open('m').read())
print len(b.data)
=2""",
    "text as bytes": """
import hashlib, struct, base64
from struct import unpack
open('t','wb').write('abcd')
t = open('t').read()
print struct.unpack('<I', t)[0] == unpack('<I', t)[0], hashlib.md5(t).hexdigest()[:4],
print base64.b64encode(t), bytearray(t)[0], t.encode('hex'), t.decode('utf-8')
=True e2fc YWJjZA== 97 61626364 abcd""",
    "StringIO is both": """
import cStringIO, StringIO, csv, zipfile
f = cStringIO.StringIO('\\xff\\xd8x'); g = StringIO.StringIO()
print >>g, 'a,b'
g.seek(0); z = zipfile.ZipFile(cStringIO.StringIO(), 'w'); z.writestr('n', 'x')
print list(csv.reader(g)), f.getvalue().find('\\xd8'), len(f.read(2)), z.namelist()
=[['a', 'b']] 1 2 ['n']""",
    "images": """
from StringIO import StringIO
import numpy as np, PIL.Image
f = StringIO()
PIL.Image.fromarray(np.zeros((4, 5, 3), np.uint8)).save(f, 'png'); open('i.png', 'w').write(f.getvalue())
print PIL.Image.open(open('i.png')).size, PIL.Image.open(StringIO(open('i.png').read())).size, 'PNG' in f.getvalue()
=(5, 4) (5, 4) True""",
    "pickles": """
import cPickle as pickle
pickle.dump({'a': 1}, open('p', 'w')); print pickle.load(open('p')),
open('q', 'w').write('S"\\xe9"\\n.'); print len(pickle.load(open('q', 'rb')))
={'a': 1} 1""",
    "csv in bytes": """
import csv
open('c', 'wb').write('1,2'); print list(csv.reader(open('c', 'rb')))
=[['1', '2']]""",
    "string": """
import string
print string.replace('a b', ' ', '-'), string.join(['a', 'b'], '-'), string.letters[:2]
=a-b a-b ab""",
    "order": "print 0.5 > None, None < -1, 'a' > 3, None >= 0\n=True True True False",
    "sort": """
a = [3, 1, 2]; a.sort(cmp=lambda x, y: y - x)
print a, sorted(a, cmp), sorted(a, cmp=cmp)
=[3, 2, 1] [1, 2, 3] [1, 2, 3]""",
    "format": "print '{:>8},{:4},'.format((1, 2), None)\n=  (1, 2),None,",
    "numbers are shown": "import numpy as np\nprint [np.float64(0.5), np.float32(2)]\n=[0.5, 2.0]",
    "a call in a class": "class A:\n    def f(self): return len('{:6}'.format(None))\nprint A().f()\n=6",
    "lmdb opened twice": """
import lmdb
a = lmdb.open('db'); b = lmdb.open('db', readonly=True)
with a.begin(write=True) as t: t.put('k', 'v')
a.close(); print str(b.begin().get('k'), 'ascii')
=v""",
}


@pytest.mark.parametrize("name", AS_PYTHON_2)
def test_text_bytes_and_order_are_those_of_python_2(name: str, tmp_path: Path) -> None:
    source, expected = AS_PYTHON_2[name].split("\n=")
    (tmp_path / "s.py").write_text(source, "latin-1")
    command = [sys.executable, "-m", "netspec", "run", "--python2", "s.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout == f"{expected}\n", done.stderr


def test_imports_beside_a_module_are_python_2s_in_packages_only(tmp_path: Path) -> None:
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
    for name, source in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(source)
    for name, printed in (("main.py", "3 1\n"), ("new.py", "7\n")):
        command = [sys.executable, "-m", "netspec", "run", name]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.stdout == printed, done.stderr


def test_a_translation_keeps_its_files_and_needs_no_netspec(tmp_path: Path) -> None:
    source = "import cStringIO\nf = cStringIO.StringIO('\\xff\\x00'); open('o', 'w').write(f.getvalue())\n"
    text = translated(f"{source}print 7 / 2, len(open('o').read())\n".encode(), "s.py", alone=True)
    (tmp_path / "new.py").write_text(text)
    done = subprocess.run([sys.executable, "new.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.stdout, "netspec" in text) == ("3 2\n", False), done.stderr

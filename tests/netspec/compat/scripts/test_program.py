"""``netspec run``: scripts and modules run as Python runs them, and ``import caffe`` finds netspec."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """``run(*words, rc=0, files={path: text}, s=text)``: netspec run, in a folder with these files and s.py."""

    def command(*words: str, rc: int = 0, files: dict[str, str] | None = None, s: str = "") -> Any:
        for name, text in {**(files or {}), "s.py": s}.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        done = subprocess.run(
            [sys.executable, "-m", "netspec", "run", *words], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == rc, done.stderr
        return done

    return command


WHO = "import sys; print(sys.argv, __name__, __file__, sys.path[0], __package__, __spec__ is None)"


def test_a_script_sees_what_python_gives_it(run: Run, tmp_path: Path) -> None:
    words = ["sub/who.py", "-x", "--gpu=1", "-minloglevel", "--plugin", "-m"]
    got = run(*words, files={"sub/who.py": WHO}).stdout
    plain = subprocess.run([sys.executable, *words], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert got == plain


def test_a_module_sees_what_python_gives_it(run: Run, tmp_path: Path) -> None:
    files = {"pack/__init__.py": "", "pack/who.py": WHO, "pack/__main__.py": WHO}
    for module in ("pack.who", "pack"):
        got = run("-m", module, "-m", "--x", files=files).stdout
        plain = [sys.executable, "-m", module, "-m", "--x"]
        assert got == subprocess.run(plain, cwd=tmp_path, capture_output=True, text=True, check=True).stdout


def test_the_exit_status_is_the_scripts(run: Run) -> None:
    assert run("s.py", rc=7, s="import sys; sys.exit(7)").stderr == ""
    assert run("s.py", rc=1, s="import sys; sys.exit('a reason')").stderr == "a reason\n"
    run("s.py", rc=130, s="raise KeyboardInterrupt")


def test_the_traceback_is_the_scripts(run: Run, tmp_path: Path) -> None:
    source = "def f(x):\n    return 1 / x\n\ntry:\n    open('nowhere')\nexcept OSError:\n    pass\nf(0)\n"
    got = run("s.py", rc=1, s=source).stderr
    plain = subprocess.run([sys.executable, "s.py"], cwd=tmp_path, capture_output=True, text=True, check=False).stderr
    assert got == plain
    assert "OSError" not in got
    assert run("s.py", rc=1, s="open('nowhere')").stderr.startswith("Traceback (most recent call last):\n")
    assert run("s.py", rc=1, s="def f(:\n").stderr.endswith("SyntaxError: invalid syntax\n")


def test_a_scripts_own_excepthook_is_called(run: Run) -> None:
    source = "import sys\nsys.excepthook = lambda kind, fault, trace: print('mine', fault)\nraise ValueError('bad')"
    assert run("s.py", rc=1, s=source).stdout == "mine bad\n"


def test_wrong_usage_and_what_is_not_there_are_one_line(run: Run) -> None:
    assert "SCRIPT, or -m MODULE" in run(rc=2).stderr
    assert run("none.py", rc=1).stderr == "none.py: cannot be read: No such file or directory\n"
    assert run("-m", "nothing.here", rc=1).stderr.startswith("-m nothing.here: ")


IMPORTS = """
import caffe
import caffe.io, caffe.draw, caffe.classifier, caffe.detector, caffe.net_spec, caffe.coord_map
import caffe.proto.caffe_pb2
from caffe._caffe import RawBlobVec
from caffe import layers as L, params as P, to_proto, NetSpec
from caffe.proto import caffe_pb2
from caffe.proto.caffe_pb2 import NetParameter, LayerParameter
import netspec.pycaffe
assert caffe is netspec.pycaffe
assert caffe.io is netspec.pycaffe.io
assert caffe.proto.caffe_pb2 is caffe_pb2 is netspec.pycaffe.proto.caffe_pb2
assert caffe.__spec__.name == caffe.__name__ == "netspec.compat.pycaffe"
assert (caffe.TRAIN, caffe.TEST) == (0, 1)
print(L.Pooling(L.Input(), pool=P.Pooling.MAX).to_proto().layer[1].name)
"""


def test_caffe_and_its_submodules_are_found(run: Run) -> None:
    assert run("s.py", s=IMPORTS).stdout == "Pooling1\n"


def test_a_module_that_caffe_has_not(run: Run) -> None:
    fault = run("s.py", rc=1, s="import caffe.nothing").stderr
    assert "No module named 'caffe.nothing'; Python files of a Caffe tree are found where its folder " in fault


def test_a_real_caffe_is_used_unless_asked(run: Run) -> None:
    script = "import caffe; print(caffe.__name__)"
    done = run("s.py", s=script, files={"caffe/__init__.py": ""})
    assert done.stdout == "caffe\n"
    assert "netspec: the Caffe that is installed at " in done.stderr
    assert run("--shadow-caffe", "s.py", s=script).stdout == "netspec.compat.pycaffe\n"


def test_caffes_sources_without_the_compiled_part_are_no_real_caffe(run: Run) -> None:
    done = run("s.py", s=f"{TREE}import caffe\nprint(caffe.__name__)", files=SOURCES)
    assert (done.stdout, "is used" in done.stderr) == ("netspec.compat.pycaffe\n", False)


SOURCES = {
    "python/caffe/__init__.py": "from .pycaffe import Net",
    "python/caffe/pycaffe.py": "from ._caffe import Net",
    "python/caffe/of_a_fork.py": "from caffe import layers as L\nvalue = 3",
    "python/caffe/old.py": "print 'two'\nvalue = 7/2",
    "python/caffe/proto/more.py": "value = 4",
    "python/caffe/test/test_it.py": "value = 5",
}
TREE = "import sys\nsys.path.insert(0, 'python')\n"


IN_A_TREE = """
from caffe import of_a_fork
import caffe.of_a_fork, caffe.old, caffe.proto.more, caffe.test.test_it
assert of_a_fork is caffe.of_a_fork and of_a_fork.value == 3
assert (caffe.old.value, caffe.proto.more.value, caffe.test.test_it.value) == (3, 4, 5)
assert not hasattr(caffe, "nothing") and caffe.io.__name__ == "netspec.compat.pycaffe.io"
"""


def test_python_files_of_a_caffe_tree_are_found_below_caffe(run: Run) -> None:
    assert run("s.py", s=TREE + IN_A_TREE, files=SOURCES).stdout == "two\n"


SPAWN = """
import multiprocessing as mp, sys
import caffe

def phases(_):
    import helper
    return len({caffe.TRAIN, caffe.TEST}), helper.half(3), 3 / 2

if __name__ == "__main__":
    for kind in sys.argv[1:]:
        pool = mp.get_context(kind).Pool(1)
        %s
        pool.terminate()
"""


@pytest.mark.parametrize(
    ("shown", "half", "kinds"),
    [("print pool.map(phases, [0])", 1, ["spawn", "fork"]), ("print(pool.map(phases, [0]))", 1.5, ["forkserver"])],
)
def test_workers_that_are_started_anew_see_what_the_program_sees(
    run: Run, shown: str, half: float, kinds: list[str]
) -> None:
    files = {"helper.py": "def half(n):\n    return n / 2", "of.a.pool.py": SPAWN % shown}
    done = run("of.a.pool.py", *kinds, files=files)
    assert done.stdout == f"[(2, {half}, {half})]\n" * len(kinds)
    assert done.stderr.count("of.a.pool.py is Python 2") == (half == 1)
    assert "Traceback" not in done.stderr  # of a worker that the pool ends


ONE = """
import sys, math
import numpy as np
w = np.ones((3, 1), np.float32)
print("%.2f %s %d" % (w[0], "a", w[1]), "%.1f" % w[2], float(w[0]) + int(w[1]), math.sqrt(w[0]))
np.set_printoptions(threshold="nan")
print(len(str(np.zeros(2000))) > 2000)
for fault in (lambda: "%d" % "a", lambda: float([1]), lambda: "%.2f" % np.ones(2)):
    try:
        fault()
    except TypeError as e:
        print(e)
"""


def test_arrays_of_one_element_are_numbers(run: Run) -> None:
    *printed, first, second, third = run("s.py", s=ONE).stdout.splitlines()
    assert printed == ["1.00 a 1 1.0 2.0 1.0", "True"]
    assert first.startswith("%d format")
    assert second.startswith("float() argument must be")
    assert third.startswith("only ")


def test_a_numpy_that_is_too_new_is_named(run: Run) -> None:
    import numpy as np

    if tuple(map(int, np.__version__.split(".")[:2])) < (2, 4):
        pytest.skip("this NumPy takes arrays of one element for numbers")
    said = f"NumPy {np.__version__} takes no array of one element for a number, as old programs expect: pip install "
    done = run("s.py", rc=1, s="import numpy as np\na = np.zeros(3)\na[0] = np.ones(1)")
    first, *_, last = done.stderr.splitlines()
    assert first.startswith(f"netspec run: warning: {said}")
    assert last.startswith(f"netspec run: {said}")
    assert run("s.py", s="print(1)").stderr == ""


def test_a_file_that_caffe_has_beside_its_code_is_named(run: Run) -> None:
    script = "import caffe, os, numpy\nnumpy.load(os.path.dirname(caffe.__file__) + '/imagenet/ilsvrc_2012_mean.npy')"
    last = run("s.py", rc=1, s=script).stderr.splitlines()[-1]
    said = "netspec run: this is python/caffe/imagenet/ilsvrc_2012_mean.npy of Caffe's sources: put a copy at /"
    assert last.startswith(said)


def test_a_dialect_is_there_before_the_script(run: Run) -> None:
    script = (
        "from caffe.proto import caffe_pb2; from caffe import params as P; print(caffe_pb2.LabelMap(), P.Resize.WARP)"
    )
    assert run("--plugin", "ssd", "s.py", s=script).stdout == " 1\n"


def test_the_log_is_shown_once_and_as_the_environment_wants_it(run: Run) -> None:
    net = 'layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 1 } } }'
    script = f"import caffe\nopen('net.prototxt', 'w').write('''{net}''')\ncaffe.Net('net.prototxt', caffe.TEST)"
    assert run("s.py", s=script).stderr.count("Creating Layer x") == 1
    assert run("-minloglevel", "2", "s.py", s=script).stderr == ""


def test_names_that_were_dropped_are_given_back_in_the_script_only(run: Run) -> None:
    script = """
import collections, time, unittest
import numpy as np
from scipy.misc import imread, imresize, imsave, factorial
import scipy.ndimage
assert (np.float, np.int, np.object, np.bool(1), np.Inf) == (float, int, object, True, float("inf"))
image = np.zeros((4, 6, 3)); image[:2] = 1
imsave("a.png", image)
assert imread("a.png").dtype == np.uint8 and imread("a.png").max() == 255
assert imread("a.png", flatten=True).shape == (4, 6)
assert imresize(imread("a.png"), (8, 12)).shape == (8, 12, 3)
assert imresize(imread("a.png"), 50).shape == imresize(imread("a.png"), 0.5).shape == (2, 3, 3)
assert scipy.ndimage.imread("a.png").shape == (4, 6, 3)
assert np.fromstring(np.arange(3).tostring(), dtype=int).tolist() == [0, 1, 2]
assert np.fromstring("1 2", sep=" ").tolist() == [1, 2]
assert set(np.random.random_integers(1, 2, 50)) == {1, 2}
assert isinstance({}, collections.Mapping) and time.clock() >= 0
unittest.TestCase().assertEquals(1, 1)
print("fine")
"""
    assert run("s.py", s=script).stdout == "fine\n"
    import numpy as np

    assert not hasattr(np, "float")
    assert not hasattr(np, "asscalar")


def test_scikit_images_old_names(run: Run) -> None:
    pytest.importorskip("skimage")
    script = """
import numpy as np, skimage.io, skimage.color
skimage.io.imsave("a.png", np.full((2, 3, 3), 255, np.uint8), check_contrast=False)
print(skimage.io.imread("a.png", as_grey=True).shape, skimage.color.rgb2grey is skimage.color.rgb2gray)
"""
    assert run("s.py", s=script).stdout == "(2, 3) True\n"


def test_keys_of_databases_may_be_text(run: Run, tmp_path: Path) -> None:
    script = """
import lmdb, numpy as np, caffe
env = lmdb.open("old_lmdb", map_size=1 << 20)
with env.begin(write=True) as txn:
    for i in range(3):
        txn.put("{:0>10d}".format(i), caffe.io.array_to_datum(np.full((1, 2, 2), i, np.uint8), i).SerializeToString())
txn = lmdb.Transaction(env=env, write=True)
txn.delete("0000000002")
txn.commit()
with env.begin() as txn:
    print([caffe.proto.caffe_pb2.Datum.FromString(value).label for key, value in txn.cursor()], txn.stat()["entries"])
    print(txn.get("0000000001") == txn.get(b"0000000001"), txn.get("none"))
env.close()
data = 'name: "d" type: "Data" top: "d" top: "l" data_param { source: "old_lmdb" backend: LMDB batch_size: 2 }'
open("net.prototxt", "w").write("layer {" + data + "}")
print(caffe.Net("net.prototxt", caffe.TRAIN).forward()["l"])
"""
    assert run("-minloglevel", "2", "s.py", s=script).stdout == "[0, 1] 2\nTrue None\n[0. 1.]\n"


def test_nothing_is_loaded_that_the_script_does_not_ask_for(run: Run) -> None:
    script = "import sys; print([name for name in ('torch', 'scipy', 'cv2') if name in sys.modules])"
    assert run("s.py", s=script).stdout == "[]\n"
    light = "import caffe; from caffe.proto import caffe_pb2; from caffe import layers as L, params as P, NetSpec\n"
    light += "L.Pooling(L.Input(), pool=P.Pooling.MAX).to_proto(); caffe.io.datum_to_array; caffe.TEST\n"
    assert run("s.py", s=light + script).stdout == "[]\n"


def test_in_a_notebook() -> None:
    code = """
import netspec
netspec.load_ipython_extension(None)
import caffe
from caffe import layers
assert caffe.__name__ == "netspec.compat.pycaffe"
import sys
del sys.modules["caffe"]
netspec.unload_ipython_extension(None)
try:
    import caffe
except ImportError:
    print("gone")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "gone\n", done.stderr


def test_a_numpy_that_pip_put_beside_the_program_gets_its_names(run: Run, tmp_path: Path) -> None:
    files = {
        "lib/numpy/__init__.py": "__version__, inf, float64 = '1.0', 1e999, 0\ndef fromstring(): pass\n"
        "set_printoptions = fromstring\n",
        "lib/other/__init__.py": "def half(n): return n / 2",
        "lib/other-1.0.dist-info/RECORD": "other/__init__.py,,\n",
    }
    script = "import sys; sys.path.insert(0, 'lib')\nimport numpy, other\nprint numpy.float, other.half(3)"
    assert run("s.py", s=script, files=files).stdout == "<class 'float'> 1.5\n"

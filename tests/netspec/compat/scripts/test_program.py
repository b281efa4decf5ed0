"""``netspec run``: scripts and modules run as Python runs them, and ``import caffe`` finds netspec.

Programs in the form of those that people have stand in programs/.
"""

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import netspec
from dnn_program import HERE
from netspec import use_dialect
from netspec.compat.scripts.python2 import fault_of_python2
from netspec.data.database import Writer
from netspec.data.datum import array_to_datum
from netspec.errors import SpecError
from netspec.net.weights import write_binary

pytestmark = pytest.mark.slow

Run = Callable[..., "subprocess.CompletedProcess[str]"]
FOLDER = Path(__file__).parent
PROGRAMS = {path.stem: path.read_text() for path in (FOLDER / "programs").glob("*.py")}
WHO = "import sys; print(sys.argv, __name__, __file__, sys.path[0], __package__, __spec__ is None)"


def test_a_script_or_module_gets_the_usual_environment(run: Run, python: Run) -> None:
    files = dict.fromkeys(("sub/who.py", "pack/who.py", "pack/__main__.py"), WHO) | {"pack/__init__.py": ""}
    words = ("-x", "--gpu=1", "-minloglevel", "--plugin", "-m")
    for command in (("sub/who.py", *words), ("-m", "pack.who", *words), ("-m", "pack", *words)):
        assert run(*command, files=files).stdout == python(*command).stdout


def test_the_exit_status_is_the_scripts(run: Run) -> None:
    assert run("s.py", rc=7, s="import sys; sys.exit(7)").stderr == ""
    assert run("s.py", rc=1, s="import sys; sys.exit('a reason')").stderr == "a reason\n"
    run("s.py", rc=130, s="raise KeyboardInterrupt")


def test_the_traceback_is_the_scripts(run: Run, python: Run) -> None:
    source = "def f(x):\n    return 1 / x\n\ntry:\n    open('nowhere')\nexcept OSError:\n    pass\nf(0)\n"
    got = run("s.py", rc=1, s=source).stderr
    assert got == python("s.py", rc=1).stderr
    assert "OSError" not in got
    assert run("s.py", rc=1, s="open('nowhere')").stderr.startswith("Traceback (most recent call last):\n")
    assert run("s.py", rc=1, s="def f(:\n").stderr.endswith("SyntaxError: invalid syntax\n")


def test_a_scripts_own_excepthook_is_called(run: Run) -> None:
    source = "import sys\nsys.excepthook = lambda kind, fault, trace: print('mine', fault)\nraise ValueError('bad')"
    assert run("s.py", rc=1, s=source).stdout == "mine bad\n"


def test_a_net_above_the_limit_is_refused(run: Run) -> None:
    """Also in a process that the script starts."""
    net = 'layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 64 dim: 3 dim: 128 dim: 128 } } }'
    script = """
import multiprocessing, sys

def build(path):
    import caffe
    caffe.Net(path, caffe.TEST)

if __name__ == "__main__":
    worker = multiprocessing.get_context("spawn").Process(target=build, args=("net.prototxt",))
    worker.start()
    worker.join()
    print("worker", worker.exitcode)
    build("net.prototxt")
"""
    done = run("--limit", "1MiB", "s.py", rc=1, s=script, files={"net.prototxt": net})
    assert done.stdout == "worker 1\n"
    assert done.stderr.count("the net needs at least 12 MiB") == 2


def test_wrong_usage_and_missing_files_are_one_line(run: Run) -> None:
    assert "SCRIPT, or -m MODULE" in run(rc=2).stderr
    missing = "none.py: cannot be read: No such file or directory; relative paths start from "
    assert run("none.py", rc=1).stderr.startswith(missing)
    assert run("-m", "nothing.here", rc=1).stderr.startswith("-m nothing.here: ")


def test_caffe_and_its_submodules_are_found(run: Run) -> None:
    assert run("s.py", s=PROGRAMS["imports"]).stdout == "Pooling1\n"


def test_sources_without_the_compiled_part_are_not_a_real_caffe(run: Run) -> None:
    done = run("s.py", s=f"{TREE}import caffe\nprint(caffe.__name__)", files=SOURCES)
    assert (done.stdout, "is used" in done.stderr) == ("netspec.compat.pycaffe\n", False)


SOURCES = {
    "python/caffe/__init__.py": "from .pycaffe import Net",
    "python/caffe/pycaffe.py": "from ._caffe import Net",
    "python/caffe/of_a_fork.py": "from caffe import layers as L\nvalue = 3",
    "python/caffe/old.py": "from .of_a_fork import value",
    "python/caffe/test/__init__.py": "",
    "python/caffe/test/test_it.py": "value = 5",
}
TREE = "import sys\nsys.path.insert(0, 'python')\n"


def test_python_files_of_a_caffe_tree_are_found_below_caffe(run: Run) -> None:
    assert run("s.py", s=TREE + PROGRAMS["in_a_tree"], files=SOURCES).stdout == "3 5\n"


@pytest.mark.parametrize("kind", ["spawn", "fork", "forkserver"])
def test_workers_get_the_programs_environment(run: Run, kind: str) -> None:
    files = {"helper.py": "def half(n):\n    return n / 2", "of.a.pool.py": PROGRAMS["workers"]}
    done = run("of.a.pool.py", kind, files=files)
    assert done.stdout == "[(2, 1.5, True)]\n"
    assert "Traceback" not in done.stderr  # of a worker that the pool ends


def test_numpys_removed_aliases_exist_in_the_script_only(run: Run) -> None:
    names = "bool int float complex object str unicode long"
    script = f"import numpy as np\nprint(*(getattr(np, name)(1).real == 1 for name in '{names}'.split()[:4]))\n"
    script += "print(np.object is object, np.str is np.unicode is str, np.long is int or np.long is np.int64)"
    assert run("s.py", s=script).stdout == "True True True True\nTrue True True\n"
    assert not hasattr(np, "float")


def fault_of(source: str) -> SpecError | None:
    try:
        exec(compile(source, "s.py", "exec"), {})
    except Exception as fault:
        return fault_of_python2(fault)
    raise AssertionError("nothing failed")


@pytest.mark.parametrize(
    ("source", "line", "construct"),
    [
        ('x = 1\nprint "x"', 2, "the statement print"),
        ("print >>f, 1".replace("f", "__import__('sys').stderr"), 1, "print >>"),
        ("exec 'x = 1'", 1, "the statement exec"),
        ("try:\n    pass\nexcept ValueError, e:\n    pass", 3, "except with a comma"),
        ("raise ValueError, 'x'", 1, "raise with a comma"),
        ("x = 0777", 1, "an octal number without 0o"),
        ("x = 7L", 1, "a number with an L"),
        ("x = ur'x'", 1, "a string with the prefix ur"),
        ("x = `1`", 1, "an expression in backquotes"),
        ("if 1 <> 2: pass", 1, "the operator <>"),
        ("f = lambda (a, b): a", 1, "a parameter that is a tuple"),
        ("def f(a, (b, c)): pass", 1, "a parameter that is a tuple"),
        ("if 1:\n\ty = 1\n        z = 2", 3, "a block indented by tabs and blanks"),
        ("def f():\n    return xrange(3)\nf()", 2, "xrange"),
        ("import cPickle", 1, "cPickle"),
        ("from itertools import izip", 1, "izip"),
        ("{}.has_key(1)", 1, "has_key"),
        ("import sys; sys.maxint", 1, "maxint"),
    ],
    ids=lambda value: value if isinstance(value, str) and "\n" not in value else "",
)
def test_python_2_is_named_with_the_construct(source: str, line: int, construct: str) -> None:
    assert re.match(
        rf"s\.py:{line}:\d+: {construct} is Python 2, not 3; convert it with `fissix -w`, ", str(fault_of(source))
    )


@pytest.mark.parametrize("source", ["def f(:\n", "printed", "x = 08", "raise (1, 2", "import nothing", "{}.no_key()"])
def test_other_faults_are_not_of_python_2(source: str) -> None:
    assert fault_of(source) is None


def test_python_2_is_one_line_with_the_construct(run: Run) -> None:
    said = run("s.py", s="import helper", files={"helper.py": "print 1"}, rc=1).stderr
    assert re.match(r"\S*helper.py:1:\d+: the statement print is Python 2, not 3; ", said)
    assert said.count("\n") == 1


def test_a_dialect_is_active_before_the_script(run: Run) -> None:
    script = (
        "from caffe.proto import caffe_pb2; from caffe import params as P; print(caffe_pb2.LabelMap(), P.Resize.WARP)"
    )
    assert run("--plugin", "ssd", "s.py", s=script).stdout == " 1\n"


def test_the_log_is_shown_once_at_the_level_of_the_environment(run: Run) -> None:
    net = 'layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 1 } } }'
    script = f"import caffe\nopen('net.prototxt', 'w').write('''{net}''')\ncaffe.Net('net.prototxt', caffe.TEST)"
    assert run("s.py", s=script).stderr.count("Creating Layer x") == 1
    assert run("-minloglevel", "2", "s.py", s=script).stderr == ""


def test_only_modules_that_the_script_imports_are_loaded(run: Run) -> None:
    script = "import sys; print([name for name in ('torch', 'scipy', 'cv2') if name in sys.modules])"
    assert run("s.py", s=script).stdout == "[]\n"
    light = "import caffe; from caffe.proto import caffe_pb2; from caffe import layers as L, params as P, NetSpec\n"
    light += "L.Pooling(L.Input(), pool=P.Pooling.MAX).to_proto(); caffe.io.datum_to_array; caffe.TEST\n"
    assert run("s.py", s=light + script).stdout == "[]\n"


def test_in_a_notebook(python: Run) -> None:
    assert python("-c", PROGRAMS["notebook"]).stdout == "gone\n"


def lines_of(run: Run, name: str) -> list[str]:
    return run("--minloglevel", "2", "s.py", s=PROGRAMS[name]).stdout.splitlines()


def test_a_program_for_ssd(run: Run, tmp_path: Path) -> None:
    for ending, name in (("prototxt", "deploy.prototxt"), ("caffemodel", "x.caffemodel")):
        shutil.copy(HERE / f"detect.{ending}", tmp_path / name)
    image = np.random.RandomState(0).rand(32, 32, 3).astype(np.float32)
    np.save(tmp_path / "image.npy", image)
    (tmp_path / "labelmap.prototxt").write_text(
        "".join(f'item {{ name: "{i}" label: {i} display_name: "thing {i}" }}\n' for i in range(3))
    )
    use_dialect("ssd")
    net = netspec.load_net(tmp_path / "deploy.prototxt", weights=tmp_path / "x.caffemodel")
    data = image[:, :, ::-1].transpose(2, 0, 1) * 255 - np.array([104, 117, 123])[:, None, None]
    rows = net(data=data[None].astype(np.float32))["detections"][0, 0]
    expected = [f"thing {int(row[1])} {row[2]:.5f} {row[3]:.5f}" for row in rows.tolist() if row[2] >= 0.85]
    assert len(expected) > 2
    assert lines_of(run, "detector") == expected


def test_a_cascade_over_an_image_pyramid(run: Run, tmp_path: Path) -> None:
    (tmp_path / "det1.prototxt").write_text((FOLDER / "nets" / "cascade.prototxt").read_text())
    net = netspec.load_net(tmp_path / "det1.prototxt", seed=1)
    write_binary(net, tmp_path / "det1.caffemodel")
    image = np.random.RandomState(3).randint(0, 256, (60, 80, 3)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "image.png"), image)
    scores: list[float] = []
    lines, scale = [], 12 / 20
    while 60 * scale >= 12:
        width, height = int(np.ceil(80 * scale)), int(np.ceil(60 * scale))
        data = (cv2.resize(image.astype(float), (width, height)) - 127.5) * 0.0078125
        prob = net(data=data.swapaxes(0, 2)[None].astype(np.float32))["prob1"].detach().numpy()
        scores += prob[0, 1][prob[0, 1] >= 0.5].tolist()
        lines.append(f"{width} {height} {prob.shape} conv4-2 prob1")
        scale *= 0.709
    *found, summary, mean = lines_of(run, "cascade")
    assert found == lines
    assert summary == "True True True"
    assert float(mean) == pytest.approx(np.mean(scores), abs=1e-4)


def test_a_program_that_reads_a_database(run: Run, tmp_path: Path) -> None:
    images = np.random.RandomState(0).randint(0, 256, (6, 3, 4, 4)).astype(np.uint8)
    with Writer(str(tmp_path / "db")) as writer:
        for i, image in enumerate(images):
            writer.put(b"%04d" % i, array_to_datum(image, i % 2).SerializeToString())
    assert lines_of(run, "database") == [
        f"0 3 {images[::2].mean():.3f}",
        f"1 3 {images[1::2].mean():.3f}",
        "(1, 3, 2, 2)",
        str(["layer", "{", "name:", '"a"', "type:", '"ReLU"', "bottom:", '"a"', "top:", '"a"', "}"]),
    ]

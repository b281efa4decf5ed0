"""Nets that need more memory than there is: one line that names the layer."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from netspec.cli import main

resource = pytest.importorskip("resource", reason="limits the memory")

NET = """input: "data" input_dim: 1 input_dim: 3 input_dim: 100 input_dim: 100
layer { name: "large" type: "InnerProduct" bottom: "data" top: "large" inner_product_param { num_output: 60000 } }
"""
WIDE = """layer { name: "wide" type: "DummyData" top: "wide" dummy_data_param { data_filler { type: "gaussian" }
  shape { dim: 40000 dim: 40000 } } }
"""


@contextmanager
def little_memory() -> Iterator[None]:
    """Limit the memory of the process to 1 GiB more than it uses."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads /proc")
@pytest.mark.parametrize(
    ("text", "said"),
    [
        (NET, 'net.prototxt:2:1: layer "large" (InnerProduct): its blobs need more memory than available'),
        (WIDE, 'net.prototxt:1:1: layer "wide" (DummyData): its pass needs more memory than available'),
    ],
    ids=["a parameter", "a blob"],
)
def test_a_layer_that_needs_too_much_memory_is_reported_in_one_line(
    text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "net.prototxt").write_text(text)
    with little_memory():
        status = main(["time", "--model", str(tmp_path / "net.prototxt"), "--iterations", "1", "--limit", "1TiB"])
    assert status == 1
    assert said in capsys.readouterr().err.splitlines()[-1]


def test_check_allocates_no_memory_for_blobs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "net.prototxt").write_text(NET + WIDE)
    with little_memory():
        assert main(["check", str(tmp_path / "net.prototxt"), "--limit", "1TiB"]) == 0
    assert "6103.86" in capsys.readouterr().out  # MiB: 40,000 x 40,000 floats, and 60,000

"""Hostile names: files of a net contain them and execute none of them; terminals, logs and errors escape them."""

import json
import logging
import os
import re
import runpy
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

import netspec
from loopclosure.errors import InputError
from netspec import log
from netspec.cli import main
from netspec.errors import SpecError, Where, printable

TRAP = Path("PWNED")  # the file that each of these names would write if it were executed
RUN = f"open('{TRAP}', 'w')"
NAMES = [
    f'x"""\n{RUN}\n"""',
    f'"+str({RUN})+"',
    f"'+str({RUN})+'",
    f'\\"""\n{RUN}#',
    f"\\'+{RUN}#",
    f"{{{RUN}}}",
    "{0.__class__}{missing}%s%(x)d",
    "a, b) + (c[",
    "</title></script><script>alert(1)</script><img src=x onerror=alert(1)>",
    "a\nb\r\n\tc\x00\x1b[31m\x7f\x85\u2028\u2029\u202e",
    "\ufffe\uffff\U0001f600\u00e9",
    "None",
    "torch",
    "__init__",
    "../../up",
    " ",
    "'",
    "\\",
]
ENDINGS = {"onnx": "onnx", "torch": "py", "safetensors": "safetensors"}


def quoted(name: str) -> str:
    """Return a name as it is written in a prototxt."""
    return '"' + "".join(f"\\{byte:03o}" for byte in name.encode()) + '"'


def net(names: Iterator[str]) -> str:
    """Return a net that uses these names for itself, its blobs and its layers."""
    own, data, other, label, conv, ip, loss, *layers = (quoted(next(names)) for _ in range(14))
    dims = "shape { dim: 2 dim: 3 dim: 6 dim: 6 }"
    return f"""name: {own}
layer {{ name: {layers[0]} type: "Input" top: {data} top: {other} input_param {{ {dims} }} }}
layer {{ name: {layers[1]} type: "Input" top: {label} input_param {{ shape {{ dim: 2 }} }} }}
layer {{ name: {layers[2]} type: "Convolution" bottom: {data} top: {conv}
  convolution_param {{ num_output: 2 kernel_size: 3 }} }}
layer {{ name: {layers[3]} type: "BatchNorm" bottom: {conv} top: {conv} }}
layer {{ name: {layers[4]} type: "InnerProduct" bottom: {conv} top: {ip} inner_product_param {{ num_output: 4 }} }}
layer {{ name: {layers[5]} type: "InnerProduct" bottom: {other} top: {loss} inner_product_param {{ num_output: 4 }} }}
layer {{ name: {layers[6]} type: "ContrastiveLoss" bottom: {ip} bottom: {loss} bottom: {label} top: "end" }}
layer {{ name: "split" type: "Slice" bottom: {ip} top: {quoted("tops" + "'" * 3)} top: "other top" }}
"""


@pytest.fixture(autouse=True)
def inside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "system", lambda *_: pytest.fail("it ran"))
    yield
    assert not TRAP.exists()


NETS = [pytest.param(net(iter(NAMES[start:] + NAMES[:start])), id=f"net_{start}") for start in (0, 9)]


@pytest.mark.slow
@pytest.mark.parametrize("text", NETS)
def test_exports_of_nets_with_hostile_names_parse_and_compute_the_same(
    text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    onnx = pytest.importorskip("onnx")
    safetensors = pytest.importorskip("safetensors.torch")
    Path("net.prototxt").write_text(text)
    here = netspec.load_net("net.prototxt", seed=0)
    netspec.save_weights(here, "net.caffemodel")
    inputs = {name: np.random.default_rng(0).random(here.shapes[name], np.float32) for name in here.inputs}
    with torch.no_grad():
        expected = {name: value.numpy() for name, value in here(**inputs).items()}
    for target, ending in ENDINGS.items():
        words = ["export", "net.prototxt", "--to", target, "--weights", "net.caffemodel", "--out", f"{target}.{ending}"]
        assert main(words) == 0, capsys.readouterr().err
    module = runpy.run_path("torch.py", run_name="__main__")["load"]()
    found = module(*(torch.from_numpy(value) for value in inputs.values()))
    assert sorted(found) == sorted(expected)
    assert all(np.allclose(found[name].detach(), value, atol=1e-5) for name, value in expected.items())
    model = onnx.load("onnx.onnx")
    onnx.checker.check_model(model)
    assert {output.name for output in model.graph.output} == set(expected)
    blobs = sum(len(layer.blobs) for layer in here.layers)
    assert len(safetensors.load_file("safetensors.safetensors")) == blobs


@pytest.mark.slow
@pytest.mark.parametrize("text", NETS)
def test_drawings_of_nets_with_hostile_names_parse(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("net.prototxt").write_text(text)
    for ending in ("svg", "html"):
        assert main(["draw", "net.prototxt", "--out", f"out.{ending}"]) == 0, capsys.readouterr().err
    ElementTree.parse("out.svg")
    html = Path("out.html").read_text(encoding="utf-8")
    assert "<img" not in html
    assert html.count("<script") <= 2
    script = re.search(r"^const layers = (.*);$", html, re.M)
    assert script
    assert json.loads(script[1])[0]["name"] == printable(netspec.load_net("net.prototxt", seed=0).plan.nodes[0].name)


EVIL = "a\\033[31m\\nI1122 10:00:00.000000     1 solver.cpp:239] Iteration 99999, loss = 0\\r\\302\\233"
NET_OF_EVIL = f"""name: "{EVIL}"
layer {{ name: "{EVIL}" type: "DummyData" top: "{EVIL}" dummy_data_param {{ shape {{ dim: 2 dim: 3 }} }} }}
layer {{ name: "ip" type: "InnerProduct" bottom: "{EVIL}" top: "ip"
  inner_product_param {{ num_output: 2 weight_filler {{ type: "xavier" }} }} }}
layer {{ name: "loss" type: "EuclideanLoss" bottom: "ip" bottom: "ip" top: "{EVIL}loss" }}
"""
SOLVER = (
    'net: "net.prototxt" base_lr: 0.1 lr_policy: "fixed" max_iter: 2 display: 1 snapshot_prefix: "x" solver_mode: CPU'
)


@pytest.mark.parametrize(
    "words", ["train solver.prototxt", "check net.prototxt", "check odd.prototxt"], ids=["train", "check", "invalid"]
)
def test_control_characters_in_names_are_escaped_in_the_output_of_commands(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("net.prototxt").write_text(NET_OF_EVIL)
    Path("odd.prototxt").write_text(NET_OF_EVIL.replace('bottom: "a', 'bottom: "b'))
    Path("solver.prototxt").write_text(SOLVER)
    assert main(words.split()) == int("odd" in words)
    said = "".join(capsys.readouterr())
    assert "Iteration 99999" in said
    assert not {character for character in said if ord(character) < 32 or 127 <= ord(character) < 160} - {"\n", "\t"}
    assert not [line for line in said.splitlines() if line.startswith("I1122 10:00:00")]


@pytest.mark.parametrize(
    "error",
    [SpecError("x\x1b[0m\ny", Where("f\n")), InputError("x\x1b[0m\ny", "f\n")],
    ids=["SpecError", "InputError"],
)
def test_control_characters_in_errors_are_escaped(error: Exception) -> None:
    assert str(error) == r"f\n: x\x1b[0m\ny"


def test_log_dump_keeps_the_lines_of_a_text_and_log_info_escapes_them(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "netspec")
    log.dump("net.cpp:53", "title\n", "a: 1\nb: 2")
    log.info("net.cpp:53", "one\nline")
    assert caplog.messages == ["title\\n\na: 1\nb: 2", "one\\nline"]

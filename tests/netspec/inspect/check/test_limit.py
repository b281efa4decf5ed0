"""The limit of memory: nets and files above it are refused in one line, with the size, the layer and the place."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from google.protobuf import text_format

from netspec.cli import main
from netspec.errors import SpecError
from netspec.files import limits
from netspec.layers.contract import fillers
from netspec.layers.contract.base import Shape
from netspec.net.assembly import limit_on
from netspec.net.net import Net
from netspec.proto.schema import TEST, TRAIN, LayerParameter

MIB = 1 << 20
PARAMETERS = (Path(__file__).parent / "nets" / "parameters.prototxt").read_text()
DUMMY = (Path(__file__).parent / "nets" / "dummy.prototxt").read_text()
HUGE = (Path(__file__).parent / "nets" / "huge.prototxt").read_text()
CHAIN = 'layer { name: "data" type: "Input" top: "0" input_param { shape { dim: 1 dim: 1048576 } } }\n' + "".join(
    f'layer {{ name: "r{i}" type: "TanH" bottom: "{i}" top: "{i + 1}" }}\n' for i in range(10)
)
COMMANDS = {
    "check": ["check", "net.prototxt"],
    "time": ["time", "--model", "net.prototxt", "--iterations", "1"],
    "test": ["test", "--model", "net.prototxt", "--weights", "none.caffemodel"],
    "extract": ["extract", "--model", "net.prototxt", "--blob", "data", "--out", "x.npz"],
    "train": ["train", "--solver", "solver.prototxt"],
}


@pytest.fixture(autouse=True)
def working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("none.caffemodel").touch()
    Path("solver.prototxt").write_text('net: "net.prototxt" base_lr: 1 lr_policy: "fixed" max_iter: 1 solver_mode: CPU')


@pytest.fixture
def filled(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return the list of the sizes in bytes of all tensors filled from now on."""
    sizes: list[int] = []
    draw, constant = fillers.draw, fillers.constant

    def watched_fill(filler: Any, shape: Shape, generator: torch.Generator) -> torch.Tensor:
        sizes.append(4 * math.prod(shape))
        return draw(filler, shape, generator)

    def watched_constant(shape: Shape, value: float, device: torch.device | str = "cpu") -> torch.Tensor:
        sizes.append(0 if str(device) == "meta" else 4 * math.prod(shape))
        return constant(shape, value, device)

    monkeypatch.setattr(fillers, "draw", watched_fill)
    monkeypatch.setattr(fillers, "constant", watched_constant)
    return sizes


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("text", "limit", "said"),
    [
        (PARAMETERS, "100MiB", '3:1: layer "two" (InnerProduct): needs 235 MiB of memory, more than any other layer'),
        (DUMMY, "100MiB", '1:1: layer "first" (DummyData): needs 244 MiB of memory, more than any other layer'),
        (HUGE, "100TiB", '2:1: layer "ip" (InnerProduct): found shape (4000000, 1000000), 4,000,000,000,000 numbers'),
    ],
    ids=["parameters", "a blob", "more than an int counts"],
)
def test_nets_above_the_limit_are_refused_by_every_command(
    command: str, text: str, limit: str, said: str, filled: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("net.prototxt").write_text(text)
    assert main([*COMMANDS[command], "--limit", limit]) == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"net.prototxt:{said}")
    assert sum(filled) == 0


def test_torch_still_says_so_in_these_words() -> None:
    for size in (2**62, 2**45):
        with pytest.raises(RuntimeError) as fault:
            torch.empty(size, 2)
        assert limits.is_out_of_memory(fault.value), str(fault.value)


@pytest.mark.parametrize("method", ["setup", "forward"])
def test_the_error_of_a_layer_of_a_plugin_is_shown(
    method: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("mine.py").write_text(f"""
from netspec.layers import Layer, register

@register("BrokenByPool")
class Broken(Layer):
    def reshape(self, bottom_shapes):
        return bottom_shapes

    def {method}(self, *bottoms):
        raise RuntimeError("cannot allocate a worker: the pool is closed")
""")
    Path("net.prototxt").write_text(CHAIN.replace("TanH", "BrokenByPool"))
    assert main(["time", "--model", "net.prototxt", "--iterations", "1", "--plugin", "mine.py"]) == 1
    expected = f"mine.py:10: in {method}: RuntimeError: cannot allocate a worker: the pool is closed"
    assert capsys.readouterr().err.splitlines()[-1] == expected


DATA_LAYERS = {
    "a batch": ("image_data_param { batch_size: 400000000 }", "found shape (400000000, 3, 40, 40)"),
    "a size": ("image_data_param { new_height: 4000000000 new_width: 4000000000 }", "found shape (1, 3, 4000000000,"),
    "a size that is cropped": (
        "image_data_param { new_height: 100000 new_width: 100000 } transform_param { crop_size: 8 }",
        "found shape (3, 100000, 100000), 30,000,000,000 numbers",
    ),
    "a crop": ("transform_param { crop_size: 1000000 }", "found shape (1, 3, 1000000, 1000000)"),
    "batches ahead": ("data_param { prefetch: 4000000000 }", "batches read ahead 69.9 TiB; the limit is 1 TiB"),
}


@pytest.mark.slow
@pytest.mark.parametrize("command", ["check", "time", "train"])
@pytest.mark.parametrize("kind", DATA_LAYERS)
def test_data_layers_above_the_limit_are_refused(command: str, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Shapes known only from the data are refused before a batch is read."""
    settings, said = DATA_LAYERS[kind]
    cv2.imwrite("a.png", np.zeros((40, 40, 3), np.uint8))
    Path("list.txt").write_text("a.png 1\n")
    message = LayerParameter(name="data", type="ImageData", top=["data", "label"])
    text_format.Merge(settings, message)
    message.image_data_param.source = "list.txt"
    loss = 'layer { name: "loss" type: "Silence" bottom: "data" bottom: "label" }'
    Path("net.prototxt").write_text(f"layer {{ {text_format.MessageToString(message, as_one_line=True)} }}\n{loss}")
    words = ["--data"] if command == "check" else []
    assert main([*COMMANDS[command], *words, "--limit", "1TiB"]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith('net.prototxt:1:1: layer "data" (ImageData): ')
    assert said in last


@pytest.mark.parametrize("text", ["pad: 2000000000 dilation: 2000000000", "pad: 40000000 dilation: 40000000"])
def test_a_pass_above_the_limit_is_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The limit does not count the working memory of torch's kernels."""
    Path("net.prototxt").write_text(
        'layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 1 dim: 32 dim: 32 } } }\n'
        'layer { name: "conv" type: "Convolution" bottom: "data" top: "conv" '
        f"convolution_param {{ num_output: 1 kernel_size: 3 {text} }} }}"
    )
    assert main(COMMANDS["time"]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith('net.prototxt:2:1: layer "conv" (Convolution): its pass needs more memory than available; ')


def test_limit_on_a_gpu_is_its_memory_or_that_of_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (1, 20 * MIB))
    assert limit_on(torch.device("cuda", 1)) == 20 * MIB
    assert limit_on(torch.device("cpu")) == limits.memory()
    assert limit_on(torch.device("cuda"), 3 * MIB) == 3 * MIB
    monkeypatch.setenv(limits.LIMIT, "4MiB")
    assert limit_on(torch.device("cuda")) == 4 * MIB
    monkeypatch.setenv(limits.LIMIT, "much")
    with pytest.raises(SpecError, match=r"^NETSPEC_LIMIT: found 'much', expected a size, e.g. 16GiB$"):
        limit_on(torch.device("cpu"))


def test_a_net_above_the_limit_of_its_device_is_refused_before_filling(
    net_of: Callable[..., Net], monkeypatch: pytest.MonkeyPatch, filled: list[int]
) -> None:
    monkeypatch.setattr("netspec.net.assembly.limit_on", lambda device, limit: 20 * MIB)
    with pytest.raises(SpecError, match="the limit is 20 MiB"):
        net_of(DUMMY)
    assert sum(filled) == 0


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="no devices")
def test_an_endless_file_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    Path("list.txt").write_text("/dev/zero 1\n")
    images = 'layer { name: "d" type: "ImageData" top: "d" top: "l" image_data_param { source: "list.txt" } }'
    listed = images.replace("list.txt", "/dev/zero")
    mean = images.replace("} }", '} transform_param { mean_file: "/dev/zero" } }')
    for text in (images, listed, mean):
        Path("net.prototxt").write_text(text)
        assert main(["check", "net.prototxt", "--data"]) == 1
        assert "it is a device, not a file" in capsys.readouterr().err
    assert main(["check", "/dev/zero"]) == 1
    assert capsys.readouterr().err == "/dev/zero: cannot be read: it is a device, not a file\n"


def test_the_message_lists_the_parts_of_the_sum(capsys: pytest.CaptureFixture[str]) -> None:
    Path("net.prototxt").write_text(PARAMETERS)
    assert main(["check", "net.prototxt", "--limit", "200MiB"]) == 1
    assert capsys.readouterr().err.endswith(
        "the net needs at least 239 MiB: parameters 239 MiB, tops 477 KiB; the limit is 200 MiB; "
        "change it with --limit SIZE\n"
    )
    assert main(["check", "net.prototxt", "--limit", "1G"]) == 0
    assert "\nmemory: at least 239 MiB: parameters 239 MiB, tops 477 KiB\n" in capsys.readouterr().out


def test_shared_parameters_count_once(net_of: Callable[..., Net]) -> None:
    layers = "".join(
        f'layer {{ name: "ip{i}" type: "InnerProduct" bottom: "data" top: "ip{i}" param {{ name: "w" }} '
        "inner_product_param { num_output: 1024 bias_term: false } }\n"
        for i in range(10)
    )
    data = 'layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 1024 } } }\n'
    assert net_of(data + layers, limit=9 * MIB).need.parameters == 4 * MIB


def test_tops_count_until_their_last_use_in_phase_test(net_of: Callable[..., Net]) -> None:
    assert net_of(CHAIN, phase=TEST).need.tops == 2 * 4 * MIB
    assert net_of(CHAIN, phase=TRAIN).need.tops == 11 * 4 * MIB
    in_place = CHAIN.replace('top: "1" }', 'top: "0" }').replace('bottom: "1"', 'bottom: "0"')
    assert net_of(in_place, phase=TRAIN).need.tops == 10 * 4 * MIB


@pytest.mark.parametrize(
    ("text", "size"), [("1000", 1000), ("16GiB", 16 << 30), ("16G", 16 << 30), ("1.5 kb", 1536), ("2T", 2 << 40)]
)
def test_sizes_are_read_with_their_units(text: str, size: int) -> None:
    assert limits.read_amount(text) == size


@pytest.mark.parametrize("text", ["", "-1", "1X", "GiB", "1e9", "nan"])
def test_invalid_sizes_are_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "net.prototxt", f"--limit={text}"]) == 2
    assert "expected a size, e.g. 16GiB" in capsys.readouterr().err


def test_the_memory_of_a_container_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = limits.memory()
    monkeypatch.setattr(limits, "_CONTAINER", tmp_path / "memory.max")
    (tmp_path / "memory.max").write_text("1048576\n")
    assert limits.memory() == MIB
    (tmp_path / "memory.max").write_text("max\n")
    assert limits.memory() >= machine

"""Nets run by onnxruntime and OpenVINO: torch's results, the cache, warnings where torch runs them, and commands."""

import logging
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import netspec
from netspec.cli import main
from netspec.errors import SpecError
from netspec.export.engines import choice, model
from netspec.inspect.features.describer import Describer
from netspec.inspect.features.records import extract_records

NET = (Path(__file__).parent / "nets" / "engines.prototxt").read_text()
FIRST_GOES_FIRST = (Path(__file__).parent / "programs" / "first_goes_first.py").read_text()


@pytest.fixture
def engine(request: pytest.FixtureRequest) -> str:
    """The engine of a test: onnxruntime, or each of ``both``, whose code is the same but for two functions."""
    name = getattr(request, "param", "onnxruntime")
    pytest.importorskip("onnx")
    pytest.importorskip(name)
    return name


both = pytest.mark.parametrize("engine", ["onnxruntime", "openvino"], indirect=True)


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small net and its weights, in the working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    Path("net.prototxt").write_text(NET)
    netspec.save_weights(netspec.load_net("net.prototxt", seed=1), "net.caffemodel")
    return tmp_path


@pytest.fixture
def data() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((2, 3, 12, 12), np.float32)


def load(engine: str, **others: Any) -> Any:
    return netspec.load_net("net.prototxt", weights="net.caffemodel", engine=engine, **others)


def said(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return what netspec logged; torch.export logs its steps at level DEBUG."""
    return [record.getMessage() for record in caplog.records if record.name == "netspec"]


def entries(folder: Path) -> list[Path]:
    return sorted((folder / "cache" / "netspec").iterdir())


@both
@pytest.mark.slow
@pytest.mark.usefixtures("files")
def test_results_equal_torchs(engine: str, data: np.ndarray, caplog: pytest.LogCaptureFixture) -> None:
    net, expected = load(engine), load("torch")
    assert type(net) is netspec.Net
    net.load_state_dict(expected.state_dict())
    with caplog.at_level(logging.WARNING):
        for batch in (data, data[:1], torch.from_numpy(data)):
            found = net(data=batch)
            assert list(found) == ["feat"]
            torch.testing.assert_close(found["feat"], expected(data=batch)["feat"].detach(), rtol=1e-5, atol=1e-5)
    assert not said(caplog)
    assert net.inputs == expected.inputs
    assert net.shapes == expected.shapes
    assert list(net.params) == ["conv", "feat"]
    assert list(net.blobs) == ["feat"]


@both
@pytest.mark.slow
def test_blobs_of_keep_are_stored_in_blobs(engine: str, files: Path, data: np.ndarray) -> None:
    net, expected = load(engine), load("torch")
    net.keep = expected.keep = ["conv"]
    net(data=data)
    expected(data=data)
    assert list(net.blobs) == list(expected.blobs) == ["conv", "feat"]
    torch.testing.assert_close(net.blobs["conv"], expected.blobs["conv"].detach(), rtol=1e-5, atol=1e-5)
    assert len(entries(files)) == 1
    net.keep = "all"
    net(data=data)
    assert set(net.blobs) == {"data", "conv", "pool", "feat"}
    assert len(entries(files)) == 2


@pytest.mark.slow
def test_the_cache_finds_a_model_by_content(engine: str, files: Path, data: np.ndarray) -> None:
    first = load(engine)(data=data)["feat"]
    (entry,) = entries(files)
    made = entry.stat().st_mtime_ns
    shutil.copy("net.prototxt", "same.prototxt")
    again = netspec.load_net("same.prototxt", weights="net.caffemodel", engine=engine)(data=data)["feat"]
    assert torch.equal(first, again)
    assert entries(files) == [entry]
    assert entry.stat().st_mtime_ns == made


@pytest.mark.slow
def test_changed_parameters_take_effect_and_are_not_cached(engine: str, files: Path, data: np.ndarray) -> None:
    net, expected = load(engine), load("torch")
    net(data=data)
    for each in (net, expected):
        with torch.no_grad():
            each.params["feat"][1].fill_(3)
    torch.testing.assert_close(net(data=data)["feat"], expected(data=data)["feat"].detach(), rtol=1e-5, atol=1e-5)
    net.params["feat"][1].data[...] = 4
    expected.params["feat"][1].data[...] = 4
    torch.testing.assert_close(net(data=data)["feat"], expected(data=data)["feat"].detach(), rtol=1e-5, atol=1e-5)
    netspec.save_weights(expected, "other.caffemodel")
    other = load(engine)
    other(data=data)
    netspec.load_weights(other, "other.caffemodel")
    torch.testing.assert_close(other(data=data)["feat"], expected(data=data)["feat"].detach(), rtol=1e-5, atol=1e-5)
    assert len(entries(files)) == 1


@pytest.mark.slow
@pytest.mark.usefixtures("files")
def test_parameters_with_aliases_are_read_in_every_pass(
    engine: str, data: np.ndarray, caplog: pytest.LogCaptureFixture
) -> None:
    net = load(engine)
    net(data=data)
    held = net.params["feat"][1].data.numpy()
    with caplog.at_level(logging.WARNING), torch.no_grad():  # an autograd graph would hold them too
        for value in (1, 2):
            held[:] = value
            found = net(data=data)["feat"]
            expected = load("torch")
            expected.params["feat"][1].data.fill_(value)
            torch.testing.assert_close(found, expected(data=data)["feat"].detach(), rtol=1e-5, atol=1e-5)
    (line,) = said(caplog)
    assert "a program could change the parameters" in line


@pytest.mark.slow
@pytest.mark.usefixtures("files")
def test_nets_without_parameters_are_told_apart(engine: str, data: np.ndarray) -> None:
    text = NET.partition('layer { name: "conv"')[0]
    for kind in ("AbsVal", "BNLL"):
        Path("net.prototxt").write_text(f'{text}layer {{ name: "y" type: "{kind}" bottom: "data" top: "y" }}')
        expected = netspec.load_net("net.prototxt")(data=data)["y"]
        found = netspec.load_net("net.prototxt", engine=engine)(data=data)["y"]
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.usefixtures("files")
def test_an_input_that_a_layer_changes_in_place_has_its_last_value(engine: str, data: np.ndarray) -> None:
    change = 'layer { name: "change" type: "ReLU" bottom: "data" top: "data" }'
    Path("net.prototxt").write_text(NET.replace('layer { name: "conv"', f'{change} layer {{ name: "conv"'))
    net = load(engine)
    net.keep = ["data"]
    net(data=data)
    np.testing.assert_array_equal(net.blobs["data"].detach(), np.maximum(data, 0))


@pytest.mark.slow
def test_models_with_random_weights_are_not_cached(engine: str, files: Path, data: np.ndarray) -> None:
    found = netspec.load_net("net.prototxt", seed=3, engine=engine)(data=data)["feat"]
    expected = netspec.load_net("net.prototxt", seed=3)(data=data)["feat"].detach()
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    assert not (files / "cache").exists()


@pytest.mark.usefixtures("files")
def test_torch_runs_passes_with_gradients(engine: str, data: np.ndarray) -> None:
    given = torch.from_numpy(data).requires_grad_()
    load(engine)(data=given)["feat"].sum().backward()
    assert given.grad is not None
    with pytest.raises(SpecError, match="no value for input 'data'"):
        load(engine)()


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize(
    ("layer", "phase", "reason"),
    [
        (
            'name: "noise" type: "Pooling" bottom: "data" top: "noise" pooling_param { kernel_size: 1 stride: 2 }',
            "TEST",
            'layer "noise"',
        ),
        ("", "TRAIN", "it runs nets in phase TEST, but this net is in phase TRAIN"),
    ],
    ids=["layer", "phase"],
)
def test_torch_runs_nets_that_the_engine_cannot_run_with_a_warning(
    layer: str, phase: str, reason: str, engine: str, data: np.ndarray, caplog: pytest.LogCaptureFixture
) -> None:
    Path("net.prototxt").write_text(NET + (f"layer {{ {layer} }}" if layer else ""))
    with caplog.at_level(logging.WARNING):
        net = netspec.load_net("net.prototxt", phase, "net.caffemodel", engine=engine)
        found = [net(data=data), net(data=data)]
    expected = netspec.load_net("net.prototxt", phase, "net.caffemodel")(data=data)
    assert all(torch.equal(each[name], value) for each in found for name, value in expected.items())
    (line,) = said(caplog)
    assert line.startswith(f"engine {engine}: ")
    assert reason in line
    assert line.endswith("; torch runs the net")


@pytest.mark.usefixtures("files")
def test_torch_runs_nets_with_recurrent_state_with_a_warning(engine: str, caplog: pytest.LogCaptureFixture) -> None:
    Path("net.prototxt").write_text(
        """layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 3 dim: 2 dim: 4 } } }
        layer { name: "cont" type: "Input" top: "cont" input_param { shape { dim: 3 dim: 2 } } }
        layer { name: "lstm" type: "LSTM" bottom: "x" bottom: "cont" top: "h"
          recurrent_param { num_output: 5 weight_filler { type: "xavier" } } }"""
    )
    with caplog.at_level(logging.WARNING):
        net, expected = (netspec.load_net("net.prototxt", seed=1, engine=each) for each in (engine, "torch"))
        for _ in range(2):
            found = [each(x=torch.ones(3, 2, 4), cont=torch.ones(3, 2))["h"] for each in (net, expected)]
            assert torch.equal(*found)
    (line,) = said(caplog)
    assert line.startswith(f'engine {engine}: net.prototxt:3:9: layer "lstm" (LSTM): its state (h, c) starts at zero')
    assert line.endswith("; torch runs the net")


@pytest.mark.slow
@pytest.mark.usefixtures("files")
def test_torch_runs_the_net_if_the_library_fails(
    engine: str, data: np.ndarray, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("out\nof order")

    monkeypatch.setitem(model.OPENERS, engine, lambda *_: fail)
    with caplog.at_level(logging.WARNING):
        found = load(engine)(data=data)["feat"]
    torch.testing.assert_close(found, load("torch")(data=data)["feat"], rtol=1e-5, atol=1e-5)
    assert said(caplog) == [f"engine {engine}: out of order; torch runs the net"]


@pytest.mark.slow
@pytest.mark.usefixtures("files")
def test_a_cache_that_cannot_be_written_gets_a_warning(
    engine: str, data: np.ndarray, caplog: pytest.LogCaptureFixture
) -> None:
    Path("file").write_text("")
    with caplog.at_level(logging.WARNING):
        load(engine, cache="file/cache")(data=data)
    assert said(caplog) == ["file/cache: cannot be written: Not a directory; the exported model will not be kept"]


@both
@pytest.mark.slow
@pytest.mark.usefixtures("files")
def test_bf16_reports_its_difference_from_fp32(engine: str, data: np.ndarray, caplog: pytest.LogCaptureFixture) -> None:
    expected = load(engine)(data=data)["feat"]
    with caplog.at_level(logging.WARNING):
        found = [load(engine, precision="bf16")(data=data)["feat"] for _ in range(2)]
    lines = said(caplog)
    if lines[0].endswith(f"; {engine} runs it in fp32"):  # the CPU or the library has no bf16
        assert torch.equal(found[0], expected)
        return
    worst = float((found[0] - expected).abs().max() / expected.abs().max())
    assert 0 < worst < 0.03
    assert lines == [f"precision bf16: feat differs from fp32 by {worst:.1e} of its largest value"] * 2


@pytest.mark.usefixtures("files")
def test_precision_bf16_with_torch_gets_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        load("torch", precision="bf16")
    assert said(caplog) == ["precision bf16: torch runs the net in fp32"]


def test_an_engine_that_is_not_installed_is_refused_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choice, "find_spec", lambda name: None if name == "openvino" else True)
    with pytest.raises(SpecError) as found:
        netspec.load_net("net.prototxt", engine="openvino")
    assert str(found.value) == "engine openvino needs the openvino library: pip install 'netspec-caffe[openvino]'"


def test_engines_use_as_many_threads_as_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    assert model.threads() == torch.get_num_threads()
    monkeypatch.setattr(sys, "modules", {})
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    assert model.threads() == 7
    monkeypatch.setenv("OMP_NUM_THREADS", "")
    assert model.threads() >= 1


# Records, commands, images


@pytest.mark.slow
def test_test_and_extract_with_an_engine_equal_torchs(
    engine: str, work_in: Callable[..., Path], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    work_in("snapshot", "sgd_step")
    words = ["--model", "sgd_step/train_val.prototxt", "--weights", "sgd_step/init.caffemodel"]
    reported = []
    for options in ([], ["--engine", engine, "--cache", str(tmp_path / "kept")]):
        assert main(["test", *words, "--iterations", "3", *options]) == 0
        reported.append([line.split("] ")[1] for line in capsys.readouterr().err.splitlines() if "loss = " in line])
    assert len(reported[0]) > 3
    numbers = [[float(line.split("loss = ")[1].split()[0]) for line in lines] for lines in reported]
    np.testing.assert_allclose(numbers[1], numbers[0], rtol=1e-4)
    plain = extract_records(netspec.load_net(words[1], weights=words[3]), ["feat"])
    assert main(["extract", *words, "--blob", "feat", "--out", "f.npz", "--engine", engine, "--cache", "none"]) == 0
    with np.load("f.npz") as found:
        np.testing.assert_allclose(found["feat"], plain["feat"], rtol=1e-4, atol=1e-5)
        assert list(found["keys"]) == list(plain["keys"])


@pytest.mark.slow
@pytest.mark.usefixtures("files")
def test_time_with_an_engine_reports_the_whole_forward_pass_only(
    engine: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["time", "--model", "net.prototxt", "--phase", "TEST", "--iterations", "2", "--engine", engine]
    assert main(words) == 0
    reported = capsys.readouterr().err
    assert "Average Forward pass: " in reported
    assert "backward" not in reported.partition("Benchmark begins")[2]
    words[4] = "TRAIN"
    assert main(words) == 0
    reported = capsys.readouterr().err
    assert (
        f"engine {engine}: it runs nets in phase TEST, but this net is in phase TRAIN; torch runs the net" in reported
    )
    assert "Average Backward pass: " in reported


def test_describer_with_an_engine_equals_torchs(engine: str, files: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (40, 30, 3), np.uint8)
    expected = Describer("net.prototxt", "net.caffemodel", zooms="1,0.5")(image)
    found = Describer("net.prototxt", "net.caffemodel", zooms="1,0.5", engine=engine)(image)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    assert len(entries(files)) == 1


@both
@pytest.mark.slow
def test_extract_of_a_cached_net_does_not_import_torch(engine: str, files: Path) -> None:
    (files / "images").mkdir()
    for k in range(17):  # more than a batch
        cv2.imwrite(f"images/{k}.png", np.random.default_rng(k).integers(0, 256, (20, 20, 3), np.uint8))
    words = "extract --model net.prototxt --weights net.caffemodel --blob feat --images images".split()
    assert main([*words, "--out", "expected.npz"]) == 0
    assert main([*words, "--out", "first.npz", "--engine", engine]) == 0
    code = "import sys; from netspec.cli import main; sys.exit(main(sys.argv[1:]) or 10 * ('torch' in sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code, *words, "--out", "second.npz", "--engine", engine], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    with np.load("expected.npz") as expected, np.load("first.npz") as first, np.load("second.npz") as second:
        np.testing.assert_allclose(first["features"], expected["features"], rtol=1e-4, atol=1e-4)
        np.testing.assert_array_equal(first["features"], second["features"])


def test_warnings_about_weights_are_given_with_a_cached_model_too(
    engine: str, files: Path, caplog: pytest.LogCaptureFixture
) -> None:
    Path("net.prototxt").write_text(NET.replace('name: "conv"', 'name: "conv_renamed"'))
    for _ in range(2):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            Describer("net.prototxt", "net.caffemodel", engine=engine)
        (line,) = said(caplog)
        assert "lacks weights for 1 of the net's 2 layers with weights: conv_renamed" in line
    assert len(entries(files)) == 1


@pytest.mark.slow
@pytest.mark.usefixtures("files")
def test_signals_are_handled_after_nets_of_openvino_are_gone() -> None:
    """OpenVINO has a signal stack for each net; the first one must not remain after the second one is deleted."""
    pytest.importorskip("onnx")
    pytest.importorskip("openvino")
    done = subprocess.run([sys.executable, "-c", FIRST_GOES_FIRST], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.usefixtures("files")
def test_an_invalid_input_size_is_refused_with_torchs_message(engine: str) -> None:
    odd = np.zeros((2, 3, 19, 12), np.float32)
    faults = []
    for net in (load("torch"), load(engine)):
        with pytest.raises(SpecError, match=r'layer "feat" .*: bottom of shape') as found:
            net(data=odd)
        faults.append(str(found.value))
    assert faults[0] == faults[1]


@both
@pytest.mark.slow
def test_a_loss_without_a_top_counts_with_every_engine(engine: str, tmp_path: Path) -> None:
    path = tmp_path / "net.prototxt"
    path.write_text("""
        layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 2 dim: 3 } } }
        layer { name: "y" type: "Input" top: "y" input_param { shape { dim: 2 } } }
        layer { name: "loss" type: "SoftmaxWithLoss" bottom: "x" bottom: "y" }
        layer { name: "accuracy" type: "Accuracy" bottom: "x" bottom: "y" top: "accuracy" }
    """)
    values = {"x": torch.tensor([[0.5, 0.2, 0.3], [0.6, 0.1, 0.3]]), "y": torch.tensor([0.0, 1])}
    with torch.no_grad():
        expected, _ = netspec.load_net(path).forward_loss(**values)
        found, outputs = netspec.load_net(path, engine=engine, cache=False).forward_loss(**values)
    assert expected is not None
    assert found is not None
    assert float(expected) > 0
    assert float(found) == pytest.approx(float(expected), rel=1e-6)
    assert sorted(outputs) == ["accuracy"]

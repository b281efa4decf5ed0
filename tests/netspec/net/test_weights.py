"""Files of weights: written and read, in Caffe's two formats and their older forms, missing layers and faults."""

import logging
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

import netspec
from netspec.errors import SpecError
from netspec.graph.filter import with_state
from netspec.graph.options import BuildOptions
from netspec.inspect.stored_weights import stored_weights
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.net.weights import load_weights, net_to_proto, save_weights
from netspec.proto.binary import net_without_numbers
from netspec.proto.schema import TRAIN, BlobProto, BlobShape, NetParameter, V0LayerParameter, V1LayerParameter
from netspec.proto.text import parse_net, parse_net_text
from paths import GOLDEN
from wire import field

CASES = sorted(path.name for path in (GOLDEN / "train").iterdir())

TOWERS = (Path(__file__).parent / "nets" / "towers.prototxt").read_text()
WIDE = (Path(__file__).parent / "nets" / "wide.prototxt").read_text()
TWO = (Path(__file__).parent / "nets" / "two.prototxt").read_text()


def net_of(text: str, seed: int = 1) -> Net:
    return build_net(*parse_net_text(text, "net.prototxt"), BuildOptions(seed=seed))


def blobs_of(net: Net) -> dict[str, list[np.ndarray]]:
    return {name: [blob.detach().numpy().copy() for blob in blobs] for name, blobs in net.params.items()}


def fill(net: Net) -> None:
    with torch.no_grad():
        for k, item in enumerate(net.learnable):
            item.parameter.copy_(torch.arange(item.parameter.numel()).view(item.parameter.shape) + 100.0 * k)
            item.parameter.grad = torch.full_like(item.parameter, 0.5)


def members(file: h5py.File, path: str) -> list[str]:
    group = file[path]
    assert isinstance(group, h5py.Group)
    return sorted(group)


@pytest.fixture
def golden_net(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Return a function that builds the TRAIN net of one of Caffe's trainings."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pairs").symlink_to(GOLDEN / "pairs")

    def build(folder: str) -> Net:
        text = (GOLDEN / folder / "train_val.prototxt").read_text()
        net, source = parse_net_text(text, "train_val.prototxt")
        net.state.phase = TRAIN
        return build_net(net, source)

    return build


@pytest.mark.parametrize("case", CASES)
def test_rewriting_caffes_weights_gives_identical_bytes(case: str, golden_net, tmp_path: Path):
    net = golden_net(f"train/{case}")
    load_weights(net, GOLDEN / "train" / case / "init.caffemodel")
    save_weights(net, tmp_path / "again.caffemodel")
    net.close()
    assert (tmp_path / "again.caffemodel").read_bytes() == (GOLDEN / "train" / case / "init.caffemodel").read_bytes()


@pytest.mark.parametrize(
    ("name", "ending", "warned"),
    [("a/b", ".h5", 1), ("a/b", "", 0), ("a", ".h5", 0)],
    ids=["slash_in_hdf5", "slash_in_binary", "no_slash_in_hdf5"],
)
def test_layer_names_with_a_slash_get_a_warning_in_hdf5_only(
    name: str, ending: str, warned: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    net = net_of(
        'layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 1 dim: 2 } } }'
        f'layer {{ name: "{name}" type: "InnerProduct" bottom: "x" top: "y" inner_product_param {{ num_output: 1 }} }}'
    )
    save_weights(net, tmp_path / f"w.caffemodel{ending}")
    reported = [record.getMessage() for record in caplog.records if "Caffe cannot load weights" in record.getMessage()]
    assert len(reported) == warned
    assert all("a/b" in text and "BINARYPROTO" in text for text in reported)


SAME_NAME = """layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 1 dim: 2 } } }
layer { name: "ip" type: "InnerProduct" bottom: "x" top: "a" %s inner_product_param { num_output: 2 } }
layer { name: "ip" type: "InnerProduct" bottom: "a" top: "b" %s inner_product_param { num_output: 2 } }
"""


def test_hdf5_has_layers_of_one_name_only_if_they_share_their_blobs(tmp_path: Path) -> None:
    shared = 'param { name: "w" } param { name: "b" }'
    net = net_of(SAME_NAME % (shared, shared))
    fill(net)
    save_weights(net, tmp_path / "w.h5", diff=True)
    other = net_of(SAME_NAME % (shared, shared), seed=2)
    load_weights(other, tmp_path / "w.h5")
    np.testing.assert_array_equal(other.params["ip"][0].detach(), net.params["ip"][0].detach())
    with pytest.raises(SpecError, match='two layers have the name "ip"; rename one of them'):
        save_weights(net_of(SAME_NAME % ("", "")), tmp_path / "w.h5")


def test_hdf5_weights_have_the_structure_of_caffes(golden_net, tmp_path: Path):
    theirs = GOLDEN / "snapshot/h5_iter_10.caffemodel.h5"
    net = golden_net("snapshot")
    load_weights(net, theirs)
    save_weights(net, tmp_path / "again.caffemodel.h5")
    net.close()
    with h5py.File(tmp_path / "again.caffemodel.h5") as mine, h5py.File(theirs) as expected:
        names: list[list[str]] = [[], []]
        mine.visit(names[0].append)
        expected.visit(names[1].append)
        assert names[0] == names[1]
        for name in names[0]:
            written, wanted = mine[name], expected[name]
            if isinstance(wanted, h5py.Dataset):
                assert isinstance(written, h5py.Dataset)
                assert written.dtype == wanted.dtype
                assert written.chunks is None
                np.testing.assert_array_equal(written[()], wanted[()])


def test_gradients_are_written_on_request(tmp_path: Path):
    net = net_of(TOWERS)
    fill(net)
    assert list(net_to_proto(net, diff=True).layer[3].blobs[1].diff) == [0.5] * 4
    save_weights(net, tmp_path / "w.h5", diff=True)
    with h5py.File(tmp_path / "w.h5") as file:
        assert members(file, "data/ip") == ["0", "1", "p"]
        assert members(file, "data/ip/p") == []  # a sharer's data are its owner's; its diffs are written
        assert members(file, "diff/ip/p") == ["0", "1"]
        diff = file["diff/ip/0"]
        assert isinstance(diff, h5py.Dataset)
        assert diff[()].tolist() == [[0.5] * 3] * 4


def test_a_shared_blob_is_written_in_the_shape_of_each_layer(tmp_path: Path):
    net = net_of(
        """
        layer { name: "in" type: "Input" top: "a" top: "b"
          input_param { shape { dim: 2 dim: 3 } shape { dim: 2 dim: 4 } } }
        layer { name: "p" type: "InnerProduct" bottom: "a" top: "x" param { name: "w" share_mode: PERMISSIVE }
          inner_product_param { num_output: 4 bias_term: false } }
        layer { name: "q" type: "InnerProduct" bottom: "b" top: "y" param { name: "w" share_mode: PERMISSIVE }
          inner_product_param { num_output: 3 bias_term: false } }
        """
    )
    fill(net)
    save_weights(net, tmp_path / "w.caffemodel")
    proto = NetParameter.FromString((tmp_path / "w.caffemodel").read_bytes())
    assert [list(layer.blobs[0].shape.dim) for layer in proto.layer[1:]] == [[4, 3], [3, 4]]
    assert list(proto.layer[2].blobs[0].data) == list(range(12))
    before = blobs_of(net)["p"][0]
    load_weights(net, tmp_path / "w.caffemodel")
    np.testing.assert_array_equal(blobs_of(net)["p"][0], before)


def written(tmp_path: Path, proto: NetParameter) -> Path:
    path = tmp_path / "w.caffemodel"
    path.write_bytes(proto.SerializeToString())
    return path


def test_layers_missing_in_the_net_are_ignored_and_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    proto = net_to_proto(net_of(TOWERS))
    proto.layer[1].name = "other"
    with caplog.at_level(logging.INFO, "netspec"):
        load_weights(net_of(TOWERS), written(tmp_path, proto))
    assert "Ignoring source layer other" in caplog.text
    assert "Ignoring source layer ip" not in caplog.text


def file_of_wide_net(kind: str) -> bytes:
    """Return a file of weights 0 to 1199 and biases 0 to 39, long enough for numbers to be read without a copy."""
    weights, biases = np.arange(1200, dtype="<f4"), np.arange(40, dtype="<f4")
    new = [BlobProto(shape=BlobShape(dim=shape), data=data) for shape, data in (([40, 30], weights), ([40], biases))]
    old = [
        BlobProto(num=1, channels=1, height=40, width=30, data=weights),
        BlobProto(width=40, num=1, channels=1, height=1, data=biases),
    ]
    net = NetParameter(name="old")
    if kind == "V1":
        net.layers.add(name="ip", type=V1LayerParameter.INNER_PRODUCT, blobs=old)
    elif kind == "V0":
        net.layers.add().layer.CopyFrom(V0LayerParameter(name="ip", type="innerproduct", num_output=40, blobs=old))
    else:
        net.layer.add(name="ip", type="InnerProduct", blobs=new)
    stored = net.SerializeToString()
    layer = b"\x0a\x02ip\x12\x0cInnerProduct"
    shapes = [blob.shape.SerializeToString() for blob in new]
    for blob, shape in zip((weights, biases), shapes, strict=True):
        floats = {
            "floats with tags": b"".join(b"\x2d" + value.tobytes() for value in blob),
            "two runs": b"".join(field(5, part.tobytes()) for part in (blob[:20], blob[20:])),
            "numbers before the shape": field(5, blob.tobytes()),
            "an unknown field after them": field(5, blob.tobytes()) + b"\xf8\xff\xff\xff\x0f\x05",
        }.get(kind)
        if floats is not None:
            layer += field(7, floats + field(7, shape))
            stored = field(100, layer)
    return stored


@pytest.mark.parametrize(
    "kind",
    ["current", "V1", "V0", "floats with tags", "two runs", "numbers before the shape", "an unknown field after them"],
)
@pytest.mark.parametrize("transposed", [False, True], ids=["in_order", "transposed"])
def test_blobs_in_every_encoding_are_read(kind: str, transposed: bool, tmp_path: Path) -> None:
    (tmp_path / "w.caffemodel").write_bytes(file_of_wide_net(kind))
    with net_without_numbers(tmp_path / "w.caffemodel") as (message, file):
        left = file is not None and not message.layer[0].blobs[0].data
        assert left == (kind in ("current", "V1", "V0", "numbers before the shape"))
    net = net_of(WIDE)
    blob = net.layers[1].blob(0)
    if transposed:  # its memory is not in the order of the numbers
        blob.data = blob.data.t().contiguous().t()
    version = blob._version
    load_weights(net, tmp_path / "w.caffemodel")
    assert blob._version > version
    assert (blobs_of(net)["ip"][0].ravel() == np.arange(1200)).all()
    assert (blobs_of(net)["ip"][1] == np.arange(40)).all()
    stored = stored_weights(tmp_path / "w.caffemodel")["ip"]
    assert [blob.ravel().tolist() for blob in stored] == [list(range(1200)), list(range(40))]


def test_truncated_files_and_blobs_are_refused_and_change_nothing(tmp_path: Path) -> None:
    whole = file_of_wide_net("current")
    net = net_of(WIDE)
    before = blobs_of(net)["ip"][0]
    for size in (len(whole) - 1, len(whole) // 2, 30):
        (tmp_path / "cut.caffemodel").write_bytes(whole[:size])
        with pytest.raises(SpecError, match=r"cut\.caffemodel: expected a binary NetParameter, found its first"):
            load_weights(net, tmp_path / "cut.caffemodel")
    short = NetParameter.FromString(whole)
    del short.layer[0].blobs[0].data[-1]
    with pytest.raises(SpecError, match="blob 0: found 1199 numbers in data, expected 1200 for shape"):
        load_weights(net, written(tmp_path, short))
    assert (blobs_of(net)["ip"][0] == before).all()


def test_a_wrong_shape_is_refused_and_changes_nothing(tmp_path: Path):
    proto = net_to_proto(net_of(TOWERS))
    proto.layer[3].blobs[1].shape.dim[:] = [2, 2]
    net = net_of(TOWERS)
    fill(net)
    before = blobs_of(net)["ip"][0]
    message = (
        r"w\.caffemodel: cannot copy param 1 weights from layer 'ip/p'; shape mismatch\. "
        r"Source param shape is 2 2 \(4\); target param shape is 4 \(4\)\. "
        r"To learn this layer's parameters from scratch rather than copying from a saved net, rename the layer\.$"
    )
    with pytest.raises(SpecError, match=message):
        load_weights(net, written(tmp_path, proto))
    np.testing.assert_array_equal(blobs_of(net)["ip"][0], before)


def test_a_wrong_number_of_blobs_or_a_wrong_shape_is_refused(tmp_path: Path):
    proto = net_to_proto(net_of(TOWERS))
    del proto.layer[1].blobs[1:]
    with pytest.raises(SpecError, match="incompatible number of blobs for layer 'ip': 1 in the file, 2 in the net"):
        load_weights(net_of(TOWERS), written(tmp_path, proto))
    path = tmp_path / "w.caffemodel.h5"
    for contents, said in (
        ({}, "incompatible number of blobs for layer 'ip': 1 in the file, 2 in the net"),
        ({"1": np.zeros(4), "2": np.zeros(1)}, "incompatible number of blobs for layer 'ip': 3 in the file, 2 in"),
        ({"1": np.zeros((1, 4))}, r"Source param shape is 1 4 \(4\); target param shape is 4 \(4\)"),
    ):
        save_weights(net_of(TOWERS), path)
        with h5py.File(path, "r+") as file:
            del file["data/ip/1"]
            for name, values in contents.items():
                file[f"data/ip/{name}"] = values.astype(np.float32)
        with pytest.raises(SpecError, match=said):
            load_weights(net_of(TOWERS), path)


def test_the_format_is_detected_from_the_content(tmp_path: Path):
    net = net_of(TOWERS)
    save_weights(net, tmp_path / "w.h5")
    shutil.move(tmp_path / "w.h5", tmp_path / "w.caffemodel")
    load_weights(net, tmp_path / "w.caffemodel")


def test_an_hdf5_file_without_weights_is_refused(tmp_path: Path):
    with h5py.File(tmp_path / "state.h5", "w") as file:
        file.create_group("history")
    with pytest.raises(SpecError, match=r"state\.h5: .*no group /data"):
        load_weights(net_of(TOWERS), tmp_path / "state.h5")


def file_with_layers(tmp_path: Path, *layers: str, name: str = "w.caffemodel") -> Path:
    """Write weights of the net TWO that have these layers only."""
    proto = net_to_proto(net_of(TWO))
    kept = [layer for layer in proto.layer if layer.name in layers]
    del proto.layer[:]
    proto.layer.extend(kept)
    path = tmp_path / name
    path.write_bytes(NetParameter(name="some", layer=proto.layer).SerializeToString())
    return path


@pytest.mark.parametrize("ending", ["", ".h5"])
def test_one_warning_names_all_layers_without_weights(tmp_path: Path, warnings, ending: str):
    path = file_with_layers(tmp_path, "one")
    if ending:
        save_weights(net_of(TWO), path)
        path = path.with_suffix(ending)
        save_weights(net_of(TWO), path)
        with h5py.File(path, "r+") as file:
            del file["data/two"]
    net = net_of(TWO)
    before = blobs_of(net)["two"][0]
    load_weights(net, path)
    assert warnings() == [
        f"{path}: lacks weights for 1 of the net's 2 layers with weights: two; they keep the values of their fillers"
    ]
    np.testing.assert_array_equal(blobs_of(net)["two"][0], before)
    with pytest.raises(SpecError, match=r"lacks weights for 1 of the net's 2 layers with weights: two; without strict"):
        load_weights(net, path, strict=True)


def test_weights_that_fit_no_layer_are_a_warning_or_an_error(tmp_path: Path, warnings):
    path = file_with_layers(tmp_path, "in")
    load_weights(net_of(TWO), path)
    (line,) = warnings()
    assert "contains weights for none of the net's 2 layers with weights: one, two; they keep" in line
    with pytest.raises(SpecError, match="none of the net's 2 layers with weights: one, two; is it the file of an"):
        load_weights(net_of(TWO), path, need_one=True)
    load_weights(net_of(TWO), file_with_layers(tmp_path, "two"), need_one=True)


def test_several_files_together_have_all_layers_for_strict(tmp_path: Path, warnings):
    paths = [
        file_with_layers(tmp_path, "one", name="1.caffemodel"),
        file_with_layers(tmp_path, "two", name="2.caffemodel"),
    ]
    load_weights(net_of(TWO), paths, strict=True)
    assert warnings() == []


def test_a_layer_that_shares_loaded_blobs_is_not_missing(tmp_path: Path, warnings):
    proto = net_to_proto(net_of(TOWERS))
    del proto.layer[3:]  # "ip/p" and what follows
    load_weights(net_of(TOWERS), written(tmp_path, proto), strict=True)
    assert warnings() == []


def test_layers_without_blobs_or_with_weights_in_the_prototxt_are_not_missing(tmp_path: Path, warnings):
    text = TWO.replace('name: "two"', 'name: "two" blobs { shape { dim: 4 dim: 4 } %s } blobs { shape { dim: 4 } %s }')
    text %= ("data: [" + ", ".join("1" * 16) + "]", "data: [1, 2, 3, 4]")
    net = net_of(text + 'layer { name: "relu" type: "ReLU" bottom: "y" top: "y" }')
    load_weights(net, file_with_layers(tmp_path, "one"), strict=True)
    assert warnings() == []
    assert blobs_of(net)["two"][1].tolist() == [1, 2, 3, 4]


def test_load_net_with_several_weights_files_uses_the_last_one(tmp_path: Path) -> None:
    (tmp_path / "net.prototxt").write_text(TOWERS)
    files = [tmp_path / f"{seed}.caffemodel" for seed in (2, 3)]
    for seed, file in zip((2, 3), files, strict=True):
        save_weights(net_of(TOWERS, seed), file)
    loaded = netspec.load_net(tmp_path / "net.prototxt", weights=files)
    assert torch.equal(
        loaded.params["ip"][0], netspec.load_net(tmp_path / "net.prototxt", weights=files[1]).params["ip"][0]
    )


SHAPES = {
    "batch_norm": {"d0": (3, 3, 5, 5)},
    "scalar": {"d0": (4, 2, 3, 3), "d1": (4, 3), "d2": (4, 1, 2), "d3": (4,)},
}


@pytest.mark.parametrize("case", SHAPES)
def test_weights_of_batch_norm_and_scalars_are_written_as_caffe_does(case: str, tmp_path: Path) -> None:
    """Caffe writes lr_mult 0 for BatchNorm's blobs, and no shape for blobs without axes."""
    folder = GOLDEN / "caffemodel" / case
    param, source = parse_net(folder / "net.prototxt")
    options = BuildOptions(open_data=False, given_shapes=SHAPES[case])
    net = build_net(with_state(param, TRAIN), source, options)
    load_weights(net, folder / "caffe.caffemodel")
    save_weights(net, tmp_path / "ours.caffemodel")
    assert (tmp_path / "ours.caffemodel").read_bytes() == (folder / "caffe.caffemodel").read_bytes()


def test_weights_of_another_net_are_refused_with_both_names(tmp_path: Path):
    text = """name: "NAME"
        layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 3 } } }
        layer { name: "ip" type: "InnerProduct" bottom: "data" top: "ip" inner_product_param { num_output: SIZE } }"""
    save_weights(net_of(text.replace("NAME", "AlexNet").replace("SIZE", "2")), tmp_path / "w.caffemodel")
    with pytest.raises(SpecError) as fault:
        load_weights(net_of(text.replace("NAME", "VGG").replace("SIZE", "3")), tmp_path / "w.caffemodel")
    said = str(fault.value)
    assert ': these weights seem to belong to another net, "AlexNet" (this one is "VGG"): cannot copy param 0' in said
    with pytest.raises(SpecError, match=r"caffemodel: cannot copy param 0"):
        load_weights(net_of(text.replace("NAME", "AlexNet").replace("SIZE", "3")), tmp_path / "w.caffemodel")

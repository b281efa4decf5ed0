"""The messages and enums of ``caffe.proto.caffe_pb2``, with and without dialects."""

import copy
import pickle

import pytest
from google.protobuf import text_format

from netspec import use_dialect
from netspec.compat.pycaffe.net_spec import layers, params
from netspec.compat.pycaffe.proto import caffe_pb2
from netspec.compat.scripts.program import advice_on_dialects
from netspec.dialects import known
from netspec.proto import schema


@pytest.fixture
def ssd() -> None:
    use_dialect("ssd")


def test_every_message_of_the_schema_exists() -> None:
    assert len(caffe_pb2.__all__) > 60
    for name, message in schema.pool.FindFileByName("caffe.proto").message_types_by_name.items():
        assert getattr(caffe_pb2, name).DESCRIPTOR is message
        assert getattr(caffe_pb2, f"_{name.upper()}") is message


def test_enums_have_their_values_in_the_module_and_in_their_messages() -> None:
    assert (caffe_pb2.TRAIN, caffe_pb2.TEST) == (0, 1)
    assert caffe_pb2.Phase.Value("TEST") == 1
    assert caffe_pb2.Phase.Name(0) == "TRAIN"
    assert caffe_pb2.SolverParameter.GPU == caffe_pb2.SolverParameter.SolverMode.Value("GPU") == 1
    assert caffe_pb2.DataParameter.LMDB == 1
    assert caffe_pb2.PoolingParameter.AVE == 1


def test_the_text_format_reads_and_writes_them() -> None:
    net = caffe_pb2.NetParameter()
    text_format.Merge('name: "n" layer { name: "p" type: "Pooling" pooling_param { pool: AVE } }', net)
    assert net.layer[0].pooling_param.pool == caffe_pb2.PoolingParameter.AVE
    assert text_format.Parse(text_format.MessageToString(net), caffe_pb2.NetParameter()) == net
    assert caffe_pb2.NetParameter.FromString(net.SerializeToString()) == net


def test_messages_are_copied_and_pickled() -> None:
    datum = caffe_pb2.Datum(channels=3, data=b"abc")
    assert copy.deepcopy(datum) == datum == pickle.loads(pickle.dumps(datum))


def test_an_unknown_name_is_an_attribute_error_that_names_the_nearest() -> None:
    with pytest.raises(AttributeError, match='did you mean "NetParameter"'):
        _ = caffe_pb2.NetParamter


def test_import_star() -> None:
    names: dict[str, object] = {}
    exec("from netspec.compat.pycaffe.proto.caffe_pb2 import *", names)
    assert names["NetParameter"] is caffe_pb2.NetParameter
    assert names["TEST"] == 1


def test_a_dialect_adds_its_messages_and_fields(ssd: None) -> None:
    layer = caffe_pb2.LayerParameter(type="Permute", permute_param={"order": [0, 2, 3, 1]})
    assert caffe_pb2.PriorBoxParameter.CENTER_SIZE == 2
    assert text_format.Parse(str(layer), caffe_pb2.LayerParameter()) == layer
    assert "permute_param {" in str(layer)
    items = caffe_pb2.LabelMap()
    text_format.Merge('item { name: "none_of_the_above" label: 0 display_name: "background" }', items)
    assert items.item[0].display_name == "background"


def test_bytes_of_a_dialect_can_be_read_as_a_net(ssd: None) -> None:
    layer = caffe_pb2.LayerParameter(permute_param={"order": [0, 2]})
    read = schema.LayerParameter.FromString(layer.SerializeToString())
    assert list(schema.value(read, "permute_param").order) == [0, 2]


def test_without_the_dialect_its_messages_do_not_exist(ssd: None, monkeypatch: pytest.MonkeyPatch) -> None:
    before = caffe_pb2.LayerParameter
    monkeypatch.setattr(known, "_added", {})
    assert caffe_pb2.LayerParameter is schema.LayerParameter
    assert not hasattr(caffe_pb2, "LabelMap")
    use_dialect("ssd")
    assert caffe_pb2.LayerParameter is before


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("caffe_pb2.ResizeParameter", "ResizeParameter"),
        ("P.Resize.WARP", "ResizeParameter"),
        ("L.Permute(L.Input(), order=[1]).to_proto()", "Permute"),
        ("L.Convolution(L.Input(), permute_param=dict(order=[1])).to_proto()", "permute_param"),
        ("caffe_pb2.SolverParameter(eval_type='detection')", "eval_type"),
        ("text_format.Merge('layer { permute_param { order: 1 } }', caffe_pb2.NetParameter())", "permute_param"),
    ],
)
def test_an_error_names_the_dialect_that_has_a_name(line: str, name: str) -> None:
    names = {"caffe_pb2": caffe_pb2, "L": layers, "P": params, "text_format": text_format}
    with pytest.raises(Exception, match=r"ha(s|ve) no ") as caught:
        eval(line, names)
    said = f"{caught.value}; {advice_on_dialects(caught.value)}"
    assert f'dialect "ssd" has "{name}"; add --plugin ssd' in said
    assert "did you mean" not in said

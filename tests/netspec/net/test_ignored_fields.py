"""Warnings about fields without effect, and which fields the layers read."""

import inspect
import re

import numpy as np
import pytest

from netspec.errors import SpecError
from netspec.layers import Layer, layer_class, layer_types
from netspec.proto.schema import LayerParameter
from paths import GOLDEN

INPUT = 'layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 2 dim: 3 dim: 4 dim: 4 } } }\n'


def layer(kind: str, rest: str = "", name: str = "a") -> str:
    return f'layer {{ name: "{name}" type: "{kind}" bottom: "x" top: "{name}" {rest} }}\n'


@pytest.mark.parametrize(
    ("said", "text"),
    [
        (
            "pooling_param has no effect: a layer of type ReLU does not read it",
            'layer { name: "a" type: "ReLU" bottom: "x" top: "a" pooling_param { pool: MAX } }',
        ),
        (
            'convolution_param.bias_filler.std has no effect: filler "msra" does not read it',
            'layer { name: "a" type: "Convolution" bottom: "x" top: "a" '
            'convolution_param { num_output: 1 kernel_size: 1 bias_filler { type: "msra" std: 1 }} }',
        ),
        (
            "eltwise_param.coeff has no effect: a layer of type Eltwise does not read it",
            'layer { name: "a" type: "Eltwise" bottom: "x" top: "a" '
            'bottom: "x" eltwise_param { operation: MAX coeff: 2 coeff: 1 } }',
        ),
        (
            "lrn_param.k has no effect: a layer of type LRN does not read it",
            'layer { name: "a" type: "LRN" bottom: "x" top: "a" lrn_param { norm_region: WITHIN_CHANNEL k: 2 } }',
        ),
        (
            'dummy_data_param.data_filler.std has no effect: filler "constant" does not read it',
            'layer { name: "a" type: "DummyData"  top: "a" '
            "dummy_data_param { shape { dim: 1 } data_filler { std: 2 }} }",
        ),
        (
            "loss_param has no effect: a layer of type EuclideanLoss does not read it",
            'layer { name: "a" type: "EuclideanLoss" bottom: "x" top: "a" '
            'bottom: "x" loss_param { normalization: NONE } }',
        ),
    ],
    ids=["ReLU", "Convolution_filler", "Eltwise", "LRN", "DummyData_filler", "EuclideanLoss"],
)
def test_a_field_without_effect_gets_a_warning(net_of, warnings, text: str, said: str) -> None:
    net_of(INPUT + text)
    name = said.partition(" ")[0].split(".")[-1]
    place = re.search(rf"\b{name}(:| \{{)", text)
    assert place is not None
    kind = text.split('"')[3]
    where = f'net.prototxt:2:{place.start() + 1}: layer "a" ({kind})'
    assert warnings() == [f"{where}: {said}"]


def test_debug_info_of_a_net_gets_a_warning(net_of, warnings) -> None:
    net_of(INPUT + "debug_info: true")
    assert warnings() == ["net.prototxt:2:1: debug_info has no effect in a net; set it in the solver"]


def test_the_same_field_of_several_layers_gets_one_warning(net_of, warnings) -> None:
    filler = 'inner_product_param { num_output: 1 weight_filler { type: "xavier" std: 0.01 } }'
    net_of(INPUT + "".join(layer("InnerProduct", filler, name) for name in "abc"))
    (found,) = warnings()
    assert found.startswith('net.prototxt:2:128: layer "a" (InnerProduct): inner_product_param.weight_filler.std')
    assert found.endswith('filler "xavier" does not read it (also in 2 more of these layers)')


@pytest.mark.parametrize(
    "text",
    [
        layer("ReLU", "relu_param { engine: CUDNN negative_slope: 0.1 }"),
        layer("Convolution", "convolution_param { num_output: 1 kernel_size: 1 engine: CAFFE force_nd_im2col: true }"),
        layer("Eltwise", 'bottom: "x" eltwise_param { operation: PROD stable_prod_grad: false }'),
        layer("Sigmoid", "sigmoid_param { engine: CUDNN }"),
        layer("Scale", "scale_param { filler { value: 2 } bias_term: true bias_filler { value: 2 } }"),
    ],
    ids=["ReLU", "Convolution", "Eltwise", "Sigmoid", "Scale"],
)
def test_fields_that_change_no_result_get_no_warning(net_of, warnings, text: str) -> None:
    net_of(INPUT + text)
    assert warnings() == []


def test_old_transform_fields_of_a_data_layer_get_a_warning(net_of, warnings) -> None:
    net_of(
        'layer { name: "d" type: "Data" top: "d" data_param { source: "no" batch_size: 2 scale: 0.5 mirror: true } }'
        'layer { name: "i" type: "ImageData" top: "i" top: "l" image_data_param { source: "no" crop_size: 4 } '
        "data_param { prefetch: 2 batch_size: 3 } transform_param { scale: 2 } }"
        'layer { name: "w" type: "WindowData" top: "w" top: "v" '
        'window_data_param { source: "no" batch_size: 1 scale: 3 } '
        "transform_param { crop_size: 4 scale: 2 } }",
        open_data=False,
        given_shapes={"d": (2, 1, 4, 4), "i": (1, 3, 4, 4)},
    )
    assert [re.sub(r"^\S+ (layer \S+) \S+ (\S+) .*", r"\1 \2", line) for line in warnings()] == [
        'layer "d" data_param.scale',
        'layer "d" data_param.mirror',
        'layer "i" data_param.batch_size',
        'layer "i" image_data_param.crop_size',
        'layer "w" transform_param.scale',
    ]


@pytest.mark.slow
@pytest.mark.parametrize("kind", layer_types())
def test_a_layer_reads_the_fields_it_is_registered_for(kind: str) -> None:
    """If ``reads`` lacks a field, users get a false warning; if it has too many, a warning is missing."""
    cls = layer_class(kind)
    assert cls is not None
    own = {field.name for field in LayerParameter.DESCRIPTOR.fields if field.name.endswith("_param")}
    sources = [inspect.getsource(c) for c in cls.__mro__ if issubclass(c, Layer) and c is not Layer]
    named = {name for name in re.findall(r"\b\w+_param\b", "".join(sources)) if name in own}
    only_engine = {"sigmoid_param", "tanh_param"}
    assert {name.partition(".")[0] for name in cls.reads} - only_engine == named - only_engine


def test_weights_written_in_a_prototxt_are_read(net_of) -> None:
    text = layer("InnerProduct", "inner_product_param { num_output: 1 axis: -1 bias_term: false } blobs { %s }")
    net = net_of(INPUT + text % "shape { dim: 1 dim: 4 } data: 1 data: 2 data: 3 data: 4")
    np.testing.assert_array_equal(net.params["a"][0].detach().numpy(), [[1, 2, 3, 4]])
    with pytest.raises(SpecError, match=r"^net.prototxt: cannot copy param 0 weights from layer 'a'; shape mismatch"):
        net_of(INPUT + text % "shape { dim: 2 } data: 1 data: 2")


def test_every_field_of_caffes_layers_belongs_to_a_registered_layer() -> None:
    root = GOLDEN / "schema" / "fields.tsv"
    rows = [line.split("\t") for line in root.read_text().splitlines()[1:]]
    fields = {row[4] for row in rows if row[0] == "LayerParameter" and row[4].endswith("_param")}
    read = {name.partition(".")[0] for kind in layer_types() for name in getattr(layer_class(kind), "reads", ())}
    assert fields <= read

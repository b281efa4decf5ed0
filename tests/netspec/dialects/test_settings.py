"""Settings of nets that forks added and that have no effect get a warning."""

import re

import pytest

from netspec.errors import SpecError
from netspec.net.build import build_net
from netspec.proto.text import parse_net_text, parse_solver_text


def test_settings_of_types_engines_and_memory_get_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    text = """mem_param { optimize_train: true } default_forward_type: FLOAT16 engine: "MKLDNN"
        layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 } } }
        layer { name: "relu" type: "ReLU" bottom: "data" top: "relu" forward_math: FLOAT16 engine: "MKL2017" }"""
    net = build_net(*parse_net_text(text, "n.prototxt"))
    assert net.shapes["relu"] == (2,)
    for name in ("1:1: mem_param", "1:36: default_forward_type", 'layer "relu" (ReLU): forward_math'):
        assert f"{name} has no effect" in caplog.text
    assert caplog.text.count("has no effect") == 4


def test_fields_that_change_no_number_get_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    net = [
        "global_grad_scale: 1000",
        "global_grad_scale_adaptive: true",
        "eltwise_mem_sharing: false",
        "reduce_buckets: 3",
        'default_conv_algos_override: "1,1,3"',
        "default_cudnn_math_override: 0",
        "bn_stats_batch_size: 32",
        'multinode { model_parallel { layer_from: "c" num_nodes: 2 } }',
    ]
    layer = [
        "debug: true",
        "cudnn_math_override: 1",
        "multinode { num_nodes: 4 }",
        "mn_activation_param { need_reduce: false }",
        "mn_grad_compress_param { param_grad_compress_enable: true }",
    ]
    convolution = ["cudnn_convolution_algo_seeker: GET", 'conv_algos_override: "7,5,7"']
    text = f"""{" ".join(net)}
        layer {{ name: "x" type: "Input" top: "x" input_param {{ shape {{ dim: 1 dim: 3 dim: 4 dim: 4 }} }} }}
        layer {{ name: "c" type: "Convolution" bottom: "x" top: "c" {" ".join(layer)}
          convolution_param {{ num_output: 2 kernel_size: 3 engine: MKL2017 {" ".join(convolution)} }} }}"""
    assert build_net(*parse_net_text(text, "n.prototxt")).shapes["c"] == (1, 2, 2, 2)
    for field in (*net, *layer, *convolution):
        assert f"{re.split('[: ]', field)[0]} has no effect" in caplog.text
    assert caplog.text.count("has no effect") == len(net) + len(layer) + len(convolution)


@pytest.mark.parametrize(
    "layer",
    [
        'type: "ReLU" relu_param { engine: MKLDNN fuse: true }',
        'type: "LRN" lrn_param { engine: MKL2017 }',
        'type: "Pooling" pooling_param { engine: MKLDNN kernel_size: 2 }',
        'type: "Dropout" dropout_param { engine: CUDNN random_seed: 3 }',
        'type: "BatchNorm" batch_norm_param { engine: CUDNN }',
        'type: "Concat" concat_param { engine: MKL2017 }',
        'type: "Eltwise" bottom: "x" eltwise_param { engine: MKL2017 }',
        'type: "InnerProduct" inner_product_param { num_output: 2 engine: MKLDNN }',
    ],
)
def test_engines_of_forks_are_accepted(layer: str) -> None:
    text = f"""layer {{ name: "x" type: "Input" top: "x" input_param {{ shape {{ dim: 1 dim: 3 dim: 4 dim: 4 }} }} }}
        layer {{ name: "y" bottom: "x" top: "y" {layer} }}"""
    assert build_net(*parse_net_text(text, "n.prototxt")).shapes["y"]


def test_threads_caches_and_packings_of_data_layers_are_accepted() -> None:
    text = """layer { name: "d" type: "Data" top: "x"
          data_param { source: "db" batch_size: 1 cache: true precache: true threads: 2 parser_threads: 2 }
          transform_param { forward_packing: NHWC use_gpu_transform: true random_seed: 3 display: true } }
        layer { name: "i" type: "ImageData" top: "y"
          image_data_param { source: "list.txt" batch_size: 1 threads: 2 cache: true precache: true } }
        layer { name: "m" type: "MemoryData" top: "z" top: "l" memory_data_param { batch_size: 1 transpose: true } }"""
    net, _ = parse_net_text(text, "n.prototxt")
    assert [layer.name for layer in net.layer] == ["d", "i", "m"]
    solver, _ = parse_solver_text('engine: "MKLDNN" solver_data_type: FLOAT16 store_blobs_in_old_format: true', "s")
    assert not solver.HasField("type")


def test_a_field_that_changes_numbers_is_refused() -> None:
    with pytest.raises(SpecError, match='SolverParameter has no field "larc"'):
        parse_solver_text("larc: true", "s.prototxt")

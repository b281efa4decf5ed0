"""Settings that forks added: Intel's, NVIDIA's and Yuanjun Xiong's Caffe.

Some of them change the learning rate. Settings of types, memory, threads, engines and machines affect only how a fork
computes. Here they have no effect, and a warning says so; ``engine`` has none in Caffe's own fields either. A field
that changes numbers, such as ``larc``, is not declared, so it is refused.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable, Mapping
from typing import Any

from typing_extensions import override

from netspec.proto.forks import Rates

DECLARATIONS = """
enum Type { DOUBLE = 0; FLOAT = 1; FLOAT16 = 2; INT = 3; UINT = 4; }
message MemoryOptimizationParameter {
  optional bool optimize_train = 1 [default = false];
  optional bool optimize_test = 2 [default = false];
  repeated string exclude_blob = 3;
}
enum MoreEngines { MKL2017 = 3; MKLDNN = 4; }
message AllEngines { enum Engine { DEFAULT = 0; CAFFE = 1; CUDNN = 2; MKL2017 = 3; MKLDNN = 4; } }
message AlgorithmSeekers { enum Seeker { GET = 0; FINDEX = 1; } }
message Packings { enum Packing { NCHW = 0; NHWC = 1; } }
message MultinodeParameter {
  message ModelParallel {
    optional string layer_from = 1;
    optional string layer_to = 2;
    optional uint32 num_nodes = 3 [default = 0];
    optional uint32 model_parts = 4 [default = 1];
  }
  message LayerTypes { repeated string layer_type = 1; }
  repeated ModelParallel model_parallel = 1;
  optional LayerTypes compress_layer_type_list = 2;
}
message MultinodeLayerParameter {
  optional uint32 num_nodes = 1 [default = 0];
  optional uint32 model_parts = 2 [default = 1];
}
message MnActivationParameter {
  optional uint32 num_nodes_in = 1 [default = 0];
  optional uint32 num_nodes_out = 2 [default = 0];
  optional uint32 model_parts_in = 3 [default = 1];
  optional uint32 model_parts_out = 4 [default = 1];
  optional bool need_reduce = 5 [default = true];
}
message MnParamGradCompressParameter { repeated bool param_grad_compress_enable = 1; }
extend SolverParameter {
  optional int32 warmup_iter = 10048 [default = 0];
  optional float warmup_start_lr = 10049 [default = 0];
  repeated float stagelr = 10150;
  repeated int32 stageiter = 10151;
  optional float min_lr = 10152 [default = 0];
  optional int32 rampup_interval = 10153 [default = 0];
  optional float rampup_lr = 10154 [default = 0];
  optional int32 richness = 10155;
  optional string engine = 10300;
  optional Type solver_data_type = 10301 [default = FLOAT];
  optional bool store_blobs_in_old_format = 10302 [default = false];
}
extend NetParameter {
  optional string engine = 10009;
  optional Type default_forward_type = 10011 [default = FLOAT];
  optional Type default_backward_type = 10012 [default = FLOAT];
  optional Type default_forward_math = 10013 [default = FLOAT];
  optional Type default_backward_math = 10014 [default = FLOAT];
  optional MemoryOptimizationParameter mem_param = 10200;
  optional int32 richness = 10155;
  optional float global_grad_scale = 10300 [default = 1];
  optional bool global_grad_scale_adaptive = 10301 [default = false];
  optional string default_conv_algos_override = 10302;
  optional int32 reduce_buckets = 10303 [default = 6];
  optional int32 default_cudnn_math_override = 10304 [default = -1];
  optional bool eltwise_mem_sharing = 10305 [default = true];
  optional uint32 bn_stats_batch_size = 10306 [default = 0];
  optional MultinodeParameter multinode = 10307;
}
extend LayerParameter {
  optional string engine = 10149;
  optional Type forward_type = 10145 [default = FLOAT];
  optional Type backward_type = 10146 [default = FLOAT];
  optional Type forward_math = 10147 [default = FLOAT];
  optional Type backward_math = 10148 [default = FLOAT];
  optional bool debug = 10300 [default = false];
  optional int32 cudnn_math_override = 10301 [default = -1];
  optional MultinodeLayerParameter multinode = 10302;
  optional MnActivationParameter mn_activation_param = 10303;
  optional MnParamGradCompressParameter mn_grad_compress_param = 10304;
}
extend TransformationParameter {
  optional Packings.Packing forward_packing = 10300 [default = NCHW];
  optional bool use_gpu_transform = 10301 [default = false];
  optional int64 random_seed = 10302 [default = -1];
  optional bool display = 10303 [default = false];
}
extend DataParameter {
  optional uint32 threads = 10300 [default = 0];
  optional uint32 parser_threads = 10301 [default = 0];
  optional bool cache = 10302 [default = false];
  optional bool precache = 10303 [default = false];
}
extend ImageDataParameter {
  optional uint32 threads = 10300 [default = 4];
  optional bool cache = 10301 [default = false];
  optional bool precache = 10302 [default = false];
}
extend ConvolutionParameter {
  optional MoreEngines engine = 10300;
  optional AlgorithmSeekers.Seeker cudnn_convolution_algo_seeker = 10301 [default = FINDEX];
  optional string conv_algos_override = 10302;
}
// MTCNN's: the C++ layer transposes cv::Mat; arrays are read as they are
extend MemoryDataParameter { optional bool transpose = 10300 [default = false]; }
// DeepLab's: weights of another shape and the same number are read
extend V1LayerParameter { optional bool strict_dim = 10300 [default = true]; }
extend DropoutParameter {
  optional AllEngines.Engine engine = 10300;
  optional int64 random_seed = 10301 [default = -1];
}
extend LRNParameter { optional MoreEngines engine = 10300; }
extend PoolingParameter { optional MoreEngines engine = 10300; }
extend ReLUParameter {
  optional MoreEngines engine = 10300;
  optional bool fuse = 10301 [default = false];
}
extend BatchNormParameter { optional AllEngines.Engine engine = 10300; }
extend ConcatParameter { optional AllEngines.Engine engine = 10300; }
extend EltwiseParameter { optional AllEngines.Engine engine = 10300; }
extend InnerProductParameter { optional AllEngines.Engine engine = 10300; }
"""

#: The warm-up of Intel and NVIDIA: its length, initial rate and exponent
RAMPS = (("warmup_iter", "warmup_start_lr", 1), ("rampup_interval", "rampup_lr", 2))
LISTS = ("stagelr", "stageiter")  # the rates of "multifixed", and the iterations at which they end
MULTIFIXED = "multifixed"


class SettingsRates(Rates):
    """The learning rates of Intel, NVIDIA and Yuanjun Xiong."""

    policies = (MULTIFIXED,)
    fields = frozenset({*LISTS, "min_lr", *(name for ramp in RAMPS for name in ramp[:2])})

    @override
    def fault(self, param: Any) -> str:
        """Return what lr_policy "multifixed" lacks, "" for nothing."""
        added = _added(param)
        rates, ends = (len(added.get(name, ())) for name in LISTS)
        if param.lr_policy != MULTIFIXED or rates == ends > 0:
            return ""
        return f'lr_policy "multifixed" needs as many stagelr as stageiter, found {rates} and {ends}'

    @override
    def rate(self, param: Any, iteration: int, caffes: Callable[[float], Any]) -> Any:
        """Return the rate of an iteration: of a ramp, at the start, or of the policy, at least min_lr."""
        added = _added(param)
        if not added:
            return caffes(param.base_lr)
        least = added.get("min_lr", 0)
        found = _above(param, added, iteration, least, caffes)
        return max(found, least) if least else found


def _above(param: Any, added: Mapping[str, Any], iteration: int, least: float, caffes: Callable[[float], Any]) -> Any:
    for length, start, power in RAMPS:
        if iteration < added.get(length, 0):
            first = added.get(start, 0)
            return first + (param.base_lr - first) * (iteration / added[length]) ** power
    if param.lr_policy == MULTIFIXED:
        rates, ends = (added[name] for name in LISTS)
        return rates[min(bisect.bisect_left(ends, iteration), len(ends) - 1)]
    if param.lr_policy == "poly" and least:
        return caffes(param.base_lr - least) + least
    return caffes(param.base_lr)


def _added(param: Any) -> dict[str, Any]:
    """Return the fields that were given and that the dialect added, by name."""
    return {field.name: value for field, value in param.ListFields() if field.is_extension}

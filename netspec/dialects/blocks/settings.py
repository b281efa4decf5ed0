"""Settings of whole nets and solvers that forks added: Intel's, NVIDIA's and Yuanjun Xiong's Caffe.

Some of them change the learning rate. Settings of types and memory affect only how a fork computes. Here they have no
effect, and a warning says so.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable
from typing import Any

from netspec.proto.schema import added_fields

DECLARATIONS = """
enum Type { DOUBLE = 0; FLOAT = 1; FLOAT16 = 2; INT = 3; UINT = 4; }
message MemoryOptimizationParameter {
  optional bool optimize_train = 1 [default = false];
  optional bool optimize_test = 2 [default = false];
  repeated string exclude_blob = 3;
}
extend SolverParameter {
  optional int32 warmup_iter = 10048 [default = 0];
  optional float warmup_start_lr = 10049 [default = 0];
  repeated float stagelr = 10150;
  repeated int32 stageiter = 10151;
  optional float min_lr = 10152 [default = 0];
  optional int32 rampup_interval = 10153 [default = 0];
  optional float rampup_lr = 10154 [default = 0];
  optional int32 richness = 10155;
}
extend NetParameter {
  optional string engine = 10009;
  optional Type default_forward_type = 10011 [default = FLOAT];
  optional Type default_backward_type = 10012 [default = FLOAT];
  optional Type default_forward_math = 10013 [default = FLOAT];
  optional Type default_backward_math = 10014 [default = FLOAT];
  optional MemoryOptimizationParameter mem_param = 10200;
  optional int32 richness = 10155;
}
extend LayerParameter {
  optional string engine = 10149;
  optional Type forward_type = 10145 [default = FLOAT];
  optional Type backward_type = 10146 [default = FLOAT];
  optional Type forward_math = 10147 [default = FLOAT];
  optional Type backward_math = 10148 [default = FLOAT];
}
"""

#: The warm-up of Intel and NVIDIA: its length, initial rate and exponent
RAMPS = (("warmup_iter", "warmup_start_lr", 1), ("rampup_interval", "rampup_lr", 2))
POLICIES = ("multifixed",)
RATE_FIELDS = frozenset({"stagelr", "stageiter", "min_lr", *(name for ramp in RAMPS for name in ramp[:2])})


def policy_fault(param: Any) -> str:
    """Return what lr_policy "multifixed" lacks, "" for nothing."""
    rates, ends = (len(_added_value(param, name, ())) for name in ("stagelr", "stageiter"))
    if param.lr_policy != "multifixed" or rates == ends > 0:
        return ""
    return f'lr_policy "multifixed" needs as many stagelr as stageiter, found {rates} and {ends}'


def learning_rate(param: Any, iteration: int, caffes: Callable[[float], Any]) -> Any:
    """Return the rate of an iteration: of a ramp, at the start, or of the policy, at least min_lr."""
    least = _added_value(param, "min_lr")
    return max(_above(param, iteration, least, caffes), least) if least else _above(param, iteration, 0.0, caffes)


def _above(param: Any, iteration: int, least: float, caffes: Callable[[float], Any]) -> Any:
    for length, start, power in RAMPS:
        if iteration < _added_value(param, length):
            first = _added_value(param, start)
            return first + (param.base_lr - first) * (iteration / _added_value(param, length)) ** power
    if param.lr_policy == "multifixed":
        rates, ends = _added_value(param, "stagelr"), _added_value(param, "stageiter")
        return rates[min(bisect.bisect_left(ends, iteration), len(ends) - 1)]
    if param.lr_policy == "poly" and least:
        return caffes(param.base_lr - least) + least
    return caffes(param.base_lr)


def _added_value(param: Any, name: str, default: Any = 0) -> Any:
    """Return the value of a field that the dialect added; ``default`` if the dialect is not active."""
    field = added_fields.get(param.DESCRIPTOR.full_name, {}).get(name)
    return default if field is None else field.get(param)

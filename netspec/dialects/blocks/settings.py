"""Settings of whole nets and solvers that forks added: Intel's, NVIDIA's and Yuanjun Xiong's Caffe.

netspec/solver/lr_policy.py computes the rates. Settings of types and memory affect only how a fork computes. Here they
have no effect, and a warning says so.
"""

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

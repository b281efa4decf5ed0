"""happynear/caffe-windows, which recognizes faces: Normalize without a scale (blocks/normalize.py).

Its BN keeps 1 / std in blobs[3] (segmentation/segnet.py), as do wy1iu/LargeMargin_Softmax_Loss and Cysu/caffe, branch
domain-guided-dropout. Where no field shows whose a layer is, the dialect has to be named.
"""

DECLARATIONS = """
message NormalizeLengthParameter {
  optional string normalize_type = 1 [default = "L2"];
  optional bool fix_gradient = 2 [default = false];
  optional bool bp_norm = 3 [default = false];
}
extend LayerParameter {
  optional NormalizeLengthParameter normalize_param = 1214;
}
"""

"""How Caffe's layers are exported: a module of exporters for each module or package of netspec/layers."""

from netspec.export.layers import (
    activation,
    common,
    contrast,
    data,
    loss,
    normalization,
    recurrent,
    scale,
    utility,
    vision,
)

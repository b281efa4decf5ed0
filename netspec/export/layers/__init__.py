"""How Caffe's layers are exported."""

from netspec.export.layers import activation, common, loss, normalization, recurrent, utility, vision

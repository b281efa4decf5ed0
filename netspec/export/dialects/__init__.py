"""How layers of Caffe's forks are exported: a module of exporters for each package of netspec/dialects."""

from netspec.export.dialects import blocks, rcnn, segmentation, ssd, text

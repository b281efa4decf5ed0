import caffe
import caffe.io, caffe.draw, caffe.classifier, caffe.detector, caffe.net_spec, caffe.coord_map
import caffe.proto.caffe_pb2
from caffe._caffe import RawBlobVec
from caffe import layers as L, params as P, to_proto, NetSpec
from caffe.proto import caffe_pb2
from caffe.proto.caffe_pb2 import NetParameter, LayerParameter
import netspec.pycaffe
assert caffe is netspec.pycaffe
assert caffe.io is netspec.pycaffe.io
assert caffe.proto.caffe_pb2 is caffe_pb2 is netspec.pycaffe.proto.caffe_pb2
assert caffe.__spec__.name == caffe.__name__ == "netspec.compat.pycaffe"
assert (caffe.TRAIN, caffe.TEST) == (0, 1)
print(L.Pooling(L.Input(), pool=P.Pooling.MAX).to_proto().layer[1].name)

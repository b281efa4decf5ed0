import caffe, lmdb, sys
import numpy as np
from caffe.proto import caffe_pb2

env = lmdb.open(sys.argv[1] if len(sys.argv) > 1 else 'db', readonly=True)
datum = caffe_pb2.Datum()
labels = {}
with env.begin() as txn:
    for key, value in txn.cursor():
        datum.ParseFromString(value)
        data = caffe.io.datum_to_array(datum)
        labels.setdefault(datum.label, []).append(data.mean())
for label, means in sorted(labels.items()):
    print(label, len(means), '%.3f' % np.mean(means))
blob = caffe_pb2.BlobProto()
blob.ParseFromString(caffe.io.array_to_blobproto(np.ones((1, 3, 2, 2))).SerializeToString())
print(np.array(caffe.io.blobproto_to_array(blob)).shape)
net = caffe_pb2.NetParameter()
layer = net.layer.add(); layer.name, layer.type = 'a', 'ReLU'
layer.top.append('a'); layer.bottom.append('a')
print(str(net).split())

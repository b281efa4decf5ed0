import lmdb, numpy as np, caffe
env = lmdb.open("old_lmdb", map_size=1 << 20)
with env.begin(write=True) as txn:
    for i in range(3):
        txn.put("{:0>10d}".format(i), caffe.io.array_to_datum(np.full((1, 2, 2), i, np.uint8), i).SerializeToString())
txn = lmdb.Transaction(env=env, write=True)
txn.delete("0000000002")
txn.commit()
with env.begin() as txn:
    print([caffe.proto.caffe_pb2.Datum.FromString(value).label for key, value in txn.cursor()], txn.stat()["entries"])
    print(txn.get("0000000001") == txn.get(b"0000000001"), txn.get("none"))
env.close()
data = 'name: "d" type: "Data" top: "d" top: "l" data_param { source: "old_lmdb" backend: LMDB batch_size: 2 }'
open("net.prototxt", "w").write("layer {" + data + "}")
print(caffe.Net("net.prototxt", caffe.TRAIN).forward()["l"])

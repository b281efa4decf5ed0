import netspec.pycaffe as caffe
net = caffe.Net("net.prototxt", caffe.TRAIN)
solver = None

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096

def rounds(count):
    for i in range(count):
        size = 12 + 4 * (i % 5)
        net.blobs["data"].reshape(1 + i % 2, 3, size, size)
        net.blobs["data"].data[...] = i % 7
        out = net.forward()
        if i % 3:
            net.backward()
        if i % 50 == 0:
            held = [blob.data for blob in net.blobs.values()]

rounds(300)
before = resident()
rounds(2000)
print(resident() - before)

import caffe

net = caffe.Net("deploy.prototxt", "x.caffemodel", caffe.TEST)
print(net.forward()["prob"].shape)

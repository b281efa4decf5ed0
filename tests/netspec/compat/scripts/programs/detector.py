import os, sys
import numpy as np
caffe_root = './'
sys.path.insert(0, os.path.join(caffe_root, 'python'))
import caffe
from google.protobuf import text_format
from caffe.proto import caffe_pb2

class Detection:
    def __init__(self, gpu_id, model_def, model_weights, image_resize, labelmap_file):
        caffe.set_device(gpu_id)
        caffe.set_mode_gpu()
        self.image_resize = image_resize
        self.net = caffe.Net(model_def, model_weights, caffe.TEST)
        self.transformer = caffe.io.Transformer({'data': self.net.blobs['data'].data.shape})
        self.transformer.set_transpose('data', (2, 0, 1))
        self.transformer.set_mean('data', np.array([104, 117, 123]))
        self.transformer.set_raw_scale('data', 255)
        self.transformer.set_channel_swap('data', (2, 1, 0))
        self.labelmap = caffe_pb2.LabelMap()
        text_format.Merge(str(open(labelmap_file, 'r').read()), self.labelmap)

    def detect(self, image, threshold):
        self.net.blobs['data'].reshape(1, 3, self.image_resize, self.image_resize)
        self.net.blobs['data'].data[...] = self.transformer.preprocess('data', image)
        found = self.net.forward()['detections']
        names = dict((item.label, item.display_name) for item in self.labelmap.item)
        for row in found[0, 0]:
            if row[2] >= threshold:
                print('%s %.5f %.5f' % (names[int(row[1])], row[2], row[3]))

image = np.load('image.npy')
Detection(0, 'deploy.prototxt', 'x.caffemodel', 32, 'labelmap.prototxt').detect(image, 0.85)

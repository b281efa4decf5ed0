"""Programs in the form of those that people have, in Python 2, as they stand: a detector, a cascade, a database."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import netspec
from dnn_program import HERE
from netspec.data.database import Writer
from netspec.data.datum import array_to_datum
from netspec.dialects import use_dialect

pytestmark = pytest.mark.slow

Run = Callable[[str], list[str]]


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Run the text of a program in ``tmp_path``; return the lines that it prints."""

    def command(program: str) -> list[str]:
        (tmp_path / "program.py").write_text(program)
        words = [sys.executable, "-m", "netspec", "run", "--minloglevel", "2", "program.py"]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    return command


DETECTOR = """
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
                print '%s %.5f %.5f' % (names[int(row[1])], row[2], row[3])

image = np.load('image.npy')
Detection(0, 'deploy.prototxt', 'x.caffemodel', 32, 'labelmap.prototxt').detect(image, 0.85)
"""


def test_a_program_for_ssd_in_python_2(run: Run, tmp_path: Path) -> None:
    for ending, name in (("prototxt", "deploy.prototxt"), ("caffemodel", "x.caffemodel")):
        shutil.copy(HERE / f"detect.{ending}", tmp_path / name)
    image = np.random.RandomState(0).rand(32, 32, 3).astype(np.float32)
    np.save(tmp_path / "image.npy", image)
    (tmp_path / "labelmap.prototxt").write_text(
        "".join(f'item {{ name: "{i}" label: {i} display_name: "thing {i}" }}\n' for i in range(3))
    )
    use_dialect("ssd")
    net = netspec.load_net(tmp_path / "deploy.prototxt", weights=tmp_path / "x.caffemodel")
    data = image[:, :, ::-1].transpose(2, 0, 1) * 255 - np.array([104, 117, 123])[:, None, None]
    rows = net(data=data[None].astype(np.float32))["detections"][0, 0]
    expected = [f"thing {int(row[1])} {row[2]:.5f} {row[3]:.5f}" for row in rows.tolist() if row[2] >= 0.85]
    assert len(expected) > 2
    assert run(DETECTOR) == expected


CASCADE = """
import caffe, cv2, time
import numpy as np

def boxes_of(map, reg, scale, threshold):
    (x, y) = np.where(map.T >= threshold)
    score = map.T[x, y]
    found = np.array([y, x]).T
    low = np.fix((2 * found + 1) / scale).T
    high = np.fix((2 * found + 12) / scale).T
    return np.concatenate((low, high, [score], [reg[i].T[x, y] for i in xrange(4)]), axis=0).T

caffe.set_mode_cpu()
PNet = caffe.Net('det1.prototxt', 'det1.caffemodel', caffe.TEST)
img = cv2.imread('image.png').astype(np.float)
h, w = img.shape[0], img.shape[1]
scale, total, outs = 12.0 / 20, np.zeros((0, 9), np.float), []
tic = time.clock()
while min(h, w) * scale >= 12:
    hs, ws = int(np.ceil(h * scale)), int(np.ceil(w * scale))
    im_data = np.swapaxes((cv2.resize(img, (ws, hs)) - 127.5) * 0.0078125, 0, 2)
    PNet.blobs['data'].reshape(1, 3, ws, hs)
    PNet.blobs['data'].data[...] = np.array([im_data], dtype=np.float)
    out = PNet.forward()
    outs.append(out['prob1'])
    total = np.concatenate((total, boxes_of(out['prob1'][0, 1, :, :], out['conv4-2'][0], scale, 0.5)), axis=0)
    print ws, hs, out['prob1'].shape, ' '.join(sorted(out.iterkeys()))
    scale *= 0.709
print total.shape[0] > 0, time.clock() >= tic, PNet.blobs.has_key('pool1')
print '%.4f' % total[:, 4].mean()
"""


def test_a_cascade_over_an_image_pyramid_in_python_2(run: Run, tmp_path: Path) -> None:
    layers = """name: "PNet" input: "data" input_dim: 1 input_dim: 3 input_dim: 12 input_dim: 12
    layer { name: "conv1" type: "Convolution" bottom: "data" top: "conv1"
      convolution_param { num_output: 4 kernel_size: 3 weight_filler { type: "xavier" } } }
    layer { name: "PReLU1" type: "PReLU" bottom: "conv1" top: "conv1" }
    layer { name: "pool1" type: "Pooling" bottom: "conv1" top: "pool1" pooling_param { kernel_size: 2 stride: 2 } }
    layer { name: "conv3" type: "Convolution" bottom: "pool1" top: "conv3"
      convolution_param { num_output: 8 kernel_size: 5 weight_filler { type: "xavier" } } }
    layer { name: "conv4-1" type: "Convolution" bottom: "conv3" top: "conv4-1"
      convolution_param { num_output: 2 kernel_size: 1 weight_filler { type: "xavier" } } }
    layer { name: "conv4-2" type: "Convolution" bottom: "conv3" top: "conv4-2"
      convolution_param { num_output: 4 kernel_size: 1 weight_filler { type: "xavier" } } }
    layer { name: "prob1" type: "Softmax" bottom: "conv4-1" top: "prob1" }"""
    (tmp_path / "det1.prototxt").write_text(layers)
    from netspec.net.weights import write_binary

    net = netspec.load_net(tmp_path / "det1.prototxt", seed=1)
    write_binary(net, tmp_path / "det1.caffemodel")
    image = np.random.RandomState(3).randint(0, 256, (60, 80, 3)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "image.png"), image)
    scores: list[float] = []
    lines, scale = [], 12 / 20
    while 60 * scale >= 12:
        width, height = int(np.ceil(80 * scale)), int(np.ceil(60 * scale))
        data = (cv2.resize(image.astype(float), (width, height)) - 127.5) * 0.0078125
        prob = net(data=data.swapaxes(0, 2)[None].astype(np.float32))["prob1"].detach().numpy()
        scores += prob[0, 1][prob[0, 1] >= 0.5].tolist()
        lines.append(f"{width} {height} {prob.shape} conv4-2 prob1")
        scale *= 0.709
    *found, summary, mean = run(CASCADE)
    assert found == lines
    assert summary == "True True True"
    assert float(mean) == pytest.approx(np.mean(scores), abs=1e-4)


DATABASE = """
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
for label, means in sorted(labels.iteritems()):
    print label, len(means), '%.3f' % np.mean(means)
blob = caffe_pb2.BlobProto()
blob.ParseFromString(caffe.io.array_to_blobproto(np.ones((1, 3, 2, 2))).SerializeToString())
print np.array(caffe.io.blobproto_to_array(blob)).shape
net = caffe_pb2.NetParameter()
layer = net.layer.add(); layer.name, layer.type = 'a', 'ReLU'
layer.top.append('a'); layer.bottom.append('a')
print str(net).split()
"""


def test_a_program_that_reads_a_database_in_python_2(run: Run, tmp_path: Path) -> None:
    images = np.random.RandomState(0).randint(0, 256, (6, 3, 4, 4)).astype(np.uint8)
    with Writer(str(tmp_path / "db")) as writer:
        for i, image in enumerate(images):
            writer.put(b"%04d" % i, array_to_datum(image, i % 2).SerializeToString())
    assert run(DATABASE) == [
        f"0 3 {images[::2].mean():.3f}",
        f"1 3 {images[1::2].mean():.3f}",
        "(1, 3, 2, 2)",
        str(["layer", "{", "name:", '"a"', "type:", '"ReLU"', "bottom:", '"a"', "top:", '"a"', "}"]),
    ]

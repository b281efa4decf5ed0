"""Every way in which public scripts use nets and solvers: each a few lines of code that must run.

The names are those of a count over 493 public scripts. What they use around them has tests of its own: test_io,
test_caffe_pb2, test_classifier, test_net_spec and others.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import netspec.pycaffe as caffe

pytestmark = pytest.mark.slow

NETS = Path(__file__).parent / "nets"
USES = {
    "import caffe": "import netspec.pycaffe as caffe",
    "caffe.Net": "assert isinstance(net, caffe.Net)",
    "caffe.TEST": "assert caffe.TEST == 1",
    "caffe.TRAIN": "assert caffe.TRAIN == 0",
    "Net(str,str,phase)": "caffe.Net('deploy.prototxt', 'usage.caffemodel', caffe.TEST)",
    "Net(str,phase)": "caffe.Net('deploy.prototxt', caffe.TEST)",
    "Net(str,phase,weights=)": "caffe.Net('deploy.prototxt', caffe.TEST, weights='usage.caffemodel')",
    "Net(str,int,weights=)": "caffe.Net('deploy.prototxt', 1, weights='usage.caffemodel')",
    ".forward()": "out = net.forward(); assert out['prob'].shape == (2, 5); assert out['prob'].argmax() >= 0",
    "caffe.set_mode_gpu": "caffe.set_mode_gpu(); caffe.set_mode_cpu()",
    "caffe.set_mode_cpu": "caffe.set_mode_cpu()",
    "caffe.set_device": "caffe.set_device(0)",
    "net.blobs[..].data[...] = ": "net.blobs['data'].data[...] = image; assert (net.blobs['data'].data == image).all()",
    "net.blobs[..].reshape(..)": "net.blobs['data'].reshape(1, 3, 20, 20); assert net.blobs['data'].shape[2] == 20",
    "net.blobs[..].reshape": "f = net.blobs['data'].reshape; f(1, 3, 9, 9); assert net.blobs['data'].height == 9",
    "net.params[..][i].data read": "assert net.params['conv1'][0].data.shape == (4, 3, 3, 3)",
    "net.blobs[..].data.shape": "assert net.blobs['data'].data.shape[1:] == (3, 12, 12)",
    "net.blobs[..].data[index]": "net.forward(); assert net.blobs['prob'].data[0].sum() > 0.99",
    "net.params[..][i].data[..] = ": "net.params['fc2'][1].data[2] = 50; assert net.forward()['prob'][0].argmax() == 2",
    "net.blobs[..].data read": "assert net.blobs['prob'].data.dtype == np.float32",
    ".save(..)": "net.save('again.caffemodel')",
    "net.params.keys()": "assert list(net.params.keys()) == ['conv1', 'fc2']",
    "class X(caffe.Layer): setup/reshape/forward/backward": """
class X(caffe.Layer):
  def setup(self, b, t): pass
""",
    "caffe.Layer": "assert issubclass(type(net.layers[1]), caffe.Layer)",
    "net.params[..] itself": "w, b = net.params['conv1']; assert len(net.params['conv1']) == 2; assert b.count == 4",
    "solver.net": "assert solver.net.blobs['loss'].data.shape == ()",
    ".step(..)": "solver.step(2); assert solver.iter == 2",
    ".copy_from(..)": "net.copy_from('usage.caffemodel')",
    "net.params.items()": "assert [(k, v[0].data.ndim) for k, v in net.params.items()] == [('conv1', 4), ('fc2', 2)]",
    "caffe.SGDSolver": "assert isinstance(solver, caffe.SGDSolver)",
    ".inputs[i]": "assert net.inputs[0] == 'data'",
    "net.blobs[..].data[index] = ": "net.blobs['data'].data[1] = 1; assert net.blobs['data'].data[1].mean() == 1",
    "for/in net.params": "assert 'fc2' in net.params; assert [p for p in net.params] == ['conv1', 'fc2']",
    ".layers[i]": "assert net.layers[1].type == 'Convolution'; assert net.layers[1].blobs[0].data.ndim == 4",
    ".outputs[i]": "assert net.outputs[0] == 'prob'",
    ".forward_all(<blob>=)": "assert net.forward_all(data=images)['prob'].shape == (5, 5)",
    "caffe.get_solver": "assert caffe.get_solver('solver.prototxt').iter == 0",
    "net.blobs[..] itself": "blob = net.blobs['data']; assert blob.num == 2",
    ".test_nets[i]": "assert 'accuracy' in solver.test_nets[0].forward()",
    ".test_nets": "assert len(solver.test_nets) == 1",
    "._layer_names": "assert list(net._layer_names).index('fc2') == 4",
    "net.blobs.items()": "assert dict(net.blobs.items())['prob'] is net.blobs['prob']",
    "net.blobs.keys()": "assert list(net.blobs.keys()) == ['data', 'conv1', 'pool1', 'fc2', 'prob']",
    "net.outputs": "assert net.outputs == ['prob']",
    "net.inputs": "assert net.inputs == ['data']",
    ".top_names": "assert net.top_names['pool1'] == ['pool1']",
    ".solve(..)": "solver.solve(); assert solver.iter == 3",
    "solver.iter": "assert solver.iter == 0",
    ".set_input_arrays(..)": """
memory = caffe.Net('memory.prototxt', caffe.TRAIN)
memory.set_input_arrays(np.ones((4, 1, 2, 3), np.float32), np.float32([0, 1, 2, 0]))
assert memory.forward()['loss'] > 0
assert memory.blobs['label'].data.ravel().tolist() == [0, 1]
memory.forward()
assert memory.blobs['label'].data.ravel().tolist() == [2, 0]
""",
    "net.blobs[..].data.copy": "a = net.blobs['data'].data.copy(); a += 1; assert not net.blobs['data'].data.any()",
    ".forward_all(**)": "assert net.forward_all(**{net.inputs[0]: images})['prob'].shape == (5, 5)",
    ".forward(**)": "assert net.forward(**{net.inputs[0]: image})['prob'].shape == (2, 5)",
    "net.params[..][i].data.flat": """
net.params['fc2'][0].data.flat = np.arange(20)
assert net.params['fc2'][0].data[1, 0] == 4
""",
    ".bottom_names": "assert net.bottom_names['fc2'] == ['pool1']",
    ".forward(<blob>=)": "net.forward(data=image); assert (net.blobs['data'].data == image).all()",
    "caffe.set_random_seed": "caffe.set_random_seed(0)",
    "net.blobs[..].data[...]": "assert net.blobs['data'].data[...].shape == (2, 3, 12, 12)",
    "net.blobs[..].shape": "n, c, h, w = net.blobs['data'].shape; assert (n, c, h, w) == (2, 3, 12, 12)",
    "caffe._caffe.BlobVec": """
import netspec.compat.pycaffe._caffe as _caffe; assert isinstance(net.params['fc2'], _caffe.BlobVec)
""",
    "net.blobs[..].num": "b = net.blobs['data']; assert (b.num, b.channels, b.height, b.width) == (2, 3, 12, 12)",
    ".forward(pos)": "assert sorted(net.forward(['pool1'])) == ['pool1', 'prob']",
    "net.blobs[..].diff read": "net.forward(); net.backward(prob=ones); net.blobs['data'].diff.reshape(2, -1)",
    ".set_phase_test(..)": "net.set_phase_test()",
    ".set_mode_gpu(..)": "net.set_mode_gpu()",
    ".set_mode_cpu(..)": "net.set_mode_cpu()",
    ".restore(..)": "solver.snapshot(); solver.step(1); solver.restore('usage_iter_0.solverstate')",
    "caffe.init_log": "caffe.init_log()",
    "net.reshape()": "net.blobs['data'].reshape(7, 3, 12, 12); net.reshape(); assert net.blobs['prob'].shape == (7, 5)",
    ".forward(pos,pos,pos)": "assert list(net.forward(None, 'conv1', 'pool1')) == ['pool1']",
    ".backward(pos,pos)": "net.forward(); net.blobs['fc2'].diff[...] = 1; assert 'data' in net.backward(None, 'fc2')",
    "net.blobs[..].size": "assert net.blobs['data'].data.size == net.blobs['data'].count == 864",
    "net.blobs.values()": "assert len(net.blobs.values()) == 5",
    ".forward_all(**,blobs)": "assert net.forward_all(blobs=['pool1'], data=images)['pool1'].shape == (5, 4, 1, 1)",
    "net.params[..][i].shape": "assert tuple(net.params['fc2'][0].shape) == (5, 4)",
    "net.blobs[..].data.flat = ": "net.blobs['data'].data.flat = image.flat; assert net.blobs['data'].data.any()",
    ".backward()": "net.forward(); assert list(net.backward()) == ['data']",
    ".add_callback(..)": "solver.add_callback(lambda: None, lambda: None); solver.step(1)",
    "for/in net.blobs": "assert [name for name in net.blobs if 'conv' in name] == ['conv1']",
    ".forward(start)": "net.forward(start='pool1')",
    "._blob_names": "assert list(net._blob_names)[0] == 'data'",
    "._layer_names[i]": "assert net._layer_names[1] == 'conv1'",
    "._blob_names[i]": "assert net._blob_names[4] == 'prob'",
}


@pytest.mark.parametrize("use", USES)
def test_typical_uses_of_nets_and_solvers(use: str, write: Callable[..., str]) -> None:
    for name in ("deploy", "memory", "train", "solver"):
        write((NETS / f"usage_{name}.prototxt").read_text(), f"{name}.prototxt")
    net = caffe.Net("deploy.prototxt", caffe.TEST)
    net.save("usage.caffemodel")
    random = np.random.default_rng(0)
    names = {
        "caffe": caffe,
        "np": np,
        "net": net,
        "solver": caffe.SGDSolver("solver.prototxt"),
        "image": random.random((2, 3, 12, 12), np.float32),
        "images": random.random((5, 3, 12, 12), np.float32),
        "ones": np.ones((2, 5), np.float32),
    }
    exec(USES[use], names)

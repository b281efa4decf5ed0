"""Ways in which public scripts use nets, of a count over 493 of them, that no other test here has."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import netspec.pycaffe as caffe

pytestmark = pytest.mark.slow

NET = (Path(__file__).parent / "nets" / "usage_deploy.prototxt").read_text()
USES = {
    "Net(str,int,weights=)": "caffe.Net('net.prototxt', 1, weights='usage.caffemodel')",
    "net.blobs[..].reshape": "f = net.blobs['data'].reshape; f(1, 3, 9, 9); assert net.blobs['data'].height == 9",
    "net.blobs[..].data[index]": "net.forward(); assert net.blobs['prob'].data[0].sum() > 0.99",
    "net.params[..][i].data[..] = ": "net.params['fc2'][1].data[2] = 50; assert net.forward()['prob'][0].argmax() == 2",
    "net.params.keys()": "assert list(net.params.keys()) == ['conv1', 'fc2']",
    "class X(caffe.Layer): setup/reshape/forward/backward": """
class X(caffe.Layer):
  def setup(self, b, t): pass
""",
    "net.params[..] itself": "w, b = net.params['conv1']; assert len(net.params['conv1']) == 2; assert b.count == 4",
    "net.params.items()": "assert [(k, v[0].data.ndim) for k, v in net.params.items()] == [('conv1', 4), ('fc2', 2)]",
    "net.blobs[..].data[index] = ": "net.blobs['data'].data[1] = 1; assert net.blobs['data'].data[1].mean() == 1",
    "for/in net.params": "assert 'fc2' in net.params; assert [p for p in net.params] == ['conv1', 'fc2']",
    ".forward_all(<blob>=)": "assert net.forward_all(data=images)['prob'].shape == (5, 5)",
    "net.blobs[..] itself": "blob = net.blobs['data']; assert blob.num == 2",
    "net.blobs.items()": "assert dict(net.blobs.items())['prob'] is net.blobs['prob']",
    "net.blobs.keys()": "assert list(net.blobs.keys()) == ['data', 'conv1', 'pool1', 'fc2', 'prob']",
    "net.blobs[..].data.copy": "a = net.blobs['data'].data.copy(); a += 1; assert not net.blobs['data'].data.any()",
    ".forward_all(**)": "assert net.forward_all(**{net.inputs[0]: images})['prob'].shape == (5, 5)",
    ".forward(**)": "assert net.forward(**{net.inputs[0]: image})['prob'].shape == (2, 5)",
    "net.params[..][i].data.flat": """
net.params['fc2'][0].data.flat = np.arange(20)
assert net.params['fc2'][0].data[1, 0] == 4
""",
    "net.blobs[..].data[...]": "assert net.blobs['data'].data[...].shape == (2, 3, 12, 12)",
    ".forward(pos)": "assert sorted(net.forward(['pool1'])) == ['pool1', 'prob']",
    ".set_phase_test(..)": "net.set_phase_test()",
    ".set_mode_gpu(..)": "net.set_mode_gpu()",
    ".set_mode_cpu(..)": "net.set_mode_cpu()",
    ".forward(pos,pos,pos)": "assert list(net.forward(None, 'conv1', 'pool1')) == ['pool1']",
    ".backward(pos,pos)": "net.forward(); net.blobs['fc2'].diff[...] = 1; assert 'data' in net.backward(None, 'fc2')",
    "net.blobs[..].size": "assert net.blobs['data'].data.size == net.blobs['data'].count == 864",
    "net.blobs.values()": "assert len(net.blobs.values()) == 5",
    ".forward_all(**,blobs)": "assert net.forward_all(blobs=['pool1'], data=images)['pool1'].shape == (5, 4, 1, 1)",
    "net.params[..][i].shape": "assert tuple(net.params['fc2'][0].shape) == (5, 4)",
    "net.blobs[..].data.flat = ": "net.blobs['data'].data.flat = image.flat; assert net.blobs['data'].data.any()",
    "for/in net.blobs": "assert [name for name in net.blobs if 'conv' in name] == ['conv1']",
}


@pytest.mark.parametrize("use", USES)
def test_typical_uses_of_nets(use: str, net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(NET)
    net.save("usage.caffemodel")
    random = np.random.default_rng(0)
    image, images = (random.random((count, 3, 12, 12), np.float32) for count in (2, 5))
    exec(USES[use], {"caffe": caffe, "np": np, "net": net, "image": image, "images": images})

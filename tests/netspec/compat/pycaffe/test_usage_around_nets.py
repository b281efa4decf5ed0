"""Every way in which public scripts use what is around nets: each a few lines of code that must run.

The names are those of a count over 493 public scripts; what they do with nets and solvers is in test_usage.py. Not here
is what single forks have in modules of their own (caffe.tools, caffe.mpi_init and the like). The lines run as in
`netspec run`: `import caffe` finds netspec.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import netspec.pycaffe as pycaffe
from each import each
from netspec.compat.scripts import finder
from netspec.dialects import use_dialect

pytestmark = pytest.mark.slow

NET = """
layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 dim: 3 dim: 8 dim: 6 } } }
layer { name: "pool" type: "Pooling" bottom: "data" top: "prob" pooling_param { pool: AVE global_pooling: true } }
"""
BEFORE = """
import numpy as np
import caffe
from caffe import layers as L, params as P
from caffe.proto import caffe_pb2
net = caffe.Net('deploy.prototxt', caffe.TEST)
transformer = caffe.io.Transformer({'data': net.blobs['data'].data.shape})
image = np.random.rand(8, 6, 3)
"""
USES = {
    "from caffe.proto import caffe_pb2": "assert caffe_pb2.NetParameter is caffe.proto.caffe_pb2.NetParameter",
    "import caffe.proto.caffe_pb2": "import caffe.proto.caffe_pb2; caffe.proto.caffe_pb2.NetParameter()",
    "from caffe.proto.caffe_pb2 import NetParameter": "from caffe.proto.caffe_pb2 import NetParameter; NetParameter()",
    "from caffe.proto.caffe_pb2 import LayerParameter": "from caffe.proto.caffe_pb2 import LayerParameter",
    "caffe.proto.caffe_pb2": "assert caffe.proto.caffe_pb2.__name__.endswith('caffe_pb2')",
    "caffe.proto.caffe_pb2.NetParameter": (
        "from google.protobuf import text_format\n"
        "p = caffe_pb2.NetParameter(); text_format.Merge(open('deploy.prototxt').read(), p)\n"
        "assert [layer.name for layer in p.layer] == ['data', 'pool']"
    ),
    "caffe.proto.caffe_pb2.BlobProto": "b = caffe_pb2.BlobProto(); b.data.extend([1, 2]); b.shape.dim.extend([2])",
    "caffe.proto.caffe_pb2.SolverParameter": "s = caffe_pb2.SolverParameter(); s.base_lr = 0.1; s.test_iter.append(3)",
    "caffe.proto.caffe_pb2.SolverParameter.GPU": "assert caffe_pb2.SolverParameter.GPU == 1",
    "caffe.proto.caffe_pb2.Datum": "d = caffe_pb2.Datum(); d.ParseFromString(caffe_pb2.Datum().SerializeToString())",
    "caffe.proto.caffe_pb2.Datum.FromString": "assert caffe_pb2.Datum.FromString(b'').label == 0",
    "caffe.proto.caffe_pb2.LayerParameter": "caffe_pb2.LayerParameter(name='x', bottom=['a'])",
    "caffe.proto.caffe_pb2.ParamSpec": "assert caffe_pb2.ParamSpec(lr_mult=2).decay_mult == 1",
    "caffe.proto.caffe_pb2.TRAIN": "assert caffe_pb2.TRAIN == caffe.TRAIN",
    "caffe.proto.caffe_pb2.TEST": "assert caffe_pb2.TEST == caffe.TEST",
    "caffe.proto.caffe_pb2.Phase.Value": "assert caffe_pb2.Phase.Value('TEST') == 1",
    "caffe.proto.caffe_pb2.DataParameter.LMDB": "assert caffe_pb2.DataParameter.LMDB == P.Data.LMDB",
    "caffe.proto.caffe_pb2.PoolingParameter.AVE": "assert caffe_pb2.PoolingParameter.AVE == P.Pooling.AVE",
    "caffe.proto.caffe_pb2.LabelMap": "m = caffe_pb2.LabelMap(); m.item.add(name='n', label=1, display_name='d')",
    "caffe.proto.caffe_pb2.BNParameter.INFERENCE": "assert caffe_pb2.BNParameter.INFERENCE == 1",
    "caffe.io.load_image": "assert caffe.io.load_image('image.png').shape == (8, 6, 3)",
    "caffe.io.resize_image": "assert caffe.io.resize_image(image, (4, 4)).shape == (4, 4, 3)",
    "caffe.io.resize": "assert caffe.io.resize(image, (4, 4)).shape == (4, 4, 3)",
    "caffe.io.oversample": "assert caffe.io.oversample([image], (4, 4)).shape == (10, 4, 4, 3)",
    "caffe.io.array_to_datum": "assert caffe.io.array_to_datum(image.transpose(2, 0, 1), 1).label == 1",
    "caffe.io.datum_to_array": "assert caffe.io.datum_to_array(caffe.io.array_to_datum(image)).shape == image.shape",
    "caffe.io.blobproto_to_array": (
        "b = caffe_pb2.BlobProto(data=[1, 2], num=1, channels=2, height=1, width=1)\n"
        "assert caffe.io.blobproto_to_array(b)[0].mean(1).mean(1).tolist() == [1, 2]"
    ),
    "caffe.io.caffe_pb2.BlobProto.FromString": "assert not caffe.io.caffe_pb2.BlobProto.FromString(b'').data",
    "caffe.io.Transformer": "assert transformer.inputs['data'] == (2, 3, 8, 6)",
    ".set_transpose(..)": "transformer.set_transpose('data', (2, 0, 1))",
    ".set_mean(..)": "transformer.set_mean('data', np.array([104, 117, 123]))",
    ".set_channel_swap(..)": "transformer.set_channel_swap('data', (2, 1, 0))",
    ".set_raw_scale(..)": "transformer.set_raw_scale('data', 255)",
    ".set_input_scale(..)": "transformer.set_input_scale('data', 0.017)",
    ".preprocess(..)": (
        "transformer.set_transpose('data', (2, 0, 1))\n"
        "net.blobs['data'].data[...] = transformer.preprocess('data', image)\n"
        "assert np.allclose(net.forward()['prob'][1, :, 0, 0], image.mean((0, 1)), rtol=1e-5)"
    ),
    ".deprocess(..)": (
        "transformer.set_transpose('data', (2, 0, 1))\n"
        "assert transformer.deprocess('data', net.blobs['data'].data[0]).shape == (8, 6, 3)"
    ),
    "caffe.Classifier": "caffe.Classifier('deploy.prototxt', 'net.caffemodel', mean=np.ones(3), image_dims=(9, 9))",
    ".predict(..)": "assert len(caffe.Classifier('deploy.prototxt', 'net.caffemodel').predict([image], False)) == 1",
    "from caffe import params": "from caffe import params as P; assert P.Pooling.MAX == 0",
    "from caffe import layers": "from caffe import layers as L; L.ReLU(L.Input())",
    "caffe.layers.<Type>": "assert caffe.layers.ReLU(caffe.layers.Input()).fn.type_name == 'ReLU'",
    "caffe.params.<X>": "assert caffe.params.Eltwise.SUM == 1",
    "caffe.NetSpec": "n = caffe.NetSpec(); n.data = L.Input(); assert n.to_proto().layer[0].name == 'data'",
    ".to_proto(..)": "assert L.ReLU(L.Input()).to_proto().layer[1].type == 'ReLU'",
    "from caffe import to_proto": "from caffe import to_proto; assert len(to_proto(L.Input()).layer) == 1",
    "caffe.to_proto": "assert 'type: \"Input\"' in str(caffe.to_proto(L.Input()))",
    "from caffe.coord_map import crop": "from caffe.coord_map import crop",
    "caffe.coord_map.crop": (
        "data = L.Input(); up = L.Deconvolution(L.Pooling(data, kernel_size=2, stride=2), kernel_size=4, stride=2)\n"
        "import caffe.coord_map\n"
        "assert caffe.coord_map.crop(up, data).fn.params['crop_param']['offset'] == [1]"
    ),
    "import caffe.draw": "import caffe.draw; caffe.draw.draw_net_to_file",
    "caffe.draw.draw_net_to_file": (
        "import caffe.draw\ncaffe.draw.draw_net_to_file(L.ReLU(L.Input()).to_proto(), 'net.dot', 'TB')"
    ),
    "from caffe.draw import get_pydot_graph": "from caffe.draw import get_pydot_graph",
    "caffe.draw.get_pydot_graph": (
        "import caffe.draw\nassert caffe.draw.get_pydot_graph(L.ReLU(L.Input()).to_proto(), 'TB').get_nodes()"
    ),
    ".param_str": "p = L.Python(param_str='{}').to_proto().layer[0]; assert p.python_param.param_str == '{}'",
    "caffe._caffe.BlobVec": "import caffe._caffe; caffe._caffe.BlobVec",
    "import caffe": "import caffe; assert caffe.__name__ == 'netspec.compat.pycaffe'",
}


@pytest.fixture(autouse=True)
def as_in_netspec_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let ``import caffe`` find netspec, in a folder with a net, its weights and an image."""
    cv2 = pytest.importorskip("cv2")
    monkeypatch.chdir(tmp_path)
    Path("deploy.prototxt").write_text(NET)
    pycaffe.Net("deploy.prototxt", pycaffe.TEST).save("net.caffemodel")
    cv2.imwrite("image.png", np.zeros((8, 6, 3), np.uint8))
    use_dialect("ssd")
    use_dialect("blocks")
    finder.install()
    yield
    finder.uninstall()
    for name in [name for name in sys.modules if name == "caffe" or name.startswith("caffe.")]:
        del sys.modules[name]


@each("use", USES)
def test_what_scripts_do(use: str) -> None:
    if "draw" in use:
        pytest.importorskip("pydot")
    if any(word in USES[use] for word in ("load_image", "resize", "Classifier")):
        pytest.importorskip("skimage")
    exec(BEFORE + USES[use], {})

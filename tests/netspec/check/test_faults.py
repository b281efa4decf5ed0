"""Whatever ``train`` refuses before its first iteration, ``check`` reports, all at once, in the same words."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import h5py
import lmdb
import numpy as np
import pytest

import netspec
from netspec.data.blobs import from_array
from netspec.data.database import Writer
from netspec.data.datum import array_to_datum
from netspec.data.mean import write_mean

Run = Callable[..., Any]  # the fixture of conftest.py

SOLVER = """net: "net.prototxt"
base_lr: 0.1
lr_policy: "fixed"
max_iter: 1
snapshot_after_train: false
solver_mode: CPU
"""
DATA = """layer { name: "data" type: "DummyData" top: "data" top: "label"
  dummy_data_param { shape { dim: 4 dim: 3 } shape { dim: 4 dim: 2 } } }
"""
PRODUCT = """layer { name: "ip" type: "InnerProduct" bottom: "data" top: "ip" param { lr_mult: 1 }
  inner_product_param { num_output: 2
    weight_filler { type: "xavier" }
    bias_filler { type: "constant" } } }
"""
LOSS = 'layer { name: "loss" type: "EuclideanLoss" bottom: "ip" bottom: "label" top: "loss" }\n'
NET = DATA + PRODUCT + LOSS
IP = 'layer "ip" (InnerProduct): '
INPUT = 'layer { name: "in" type: "Input" top: "data" top: "label" input_param { shape { dim: 4 dim: 3 } } }\n'
TESTED = "test_iter: 1\ntest_interval: 1\n"
#: A net that reads: what stands in the place of %s is the layer's own.
READS = """layer { name: "d" type: "%s" top: "data" top: "label"
  %s }
layer { name: "hush" type: "Silence" bottom: "data" bottom: "label" }
"""


@dataclass(frozen=True)
class Case:
    """A solver and its nets, and the lines that say what is wrong with them: how each begins."""

    faults: list[str]
    solver: str = SOLVER
    net: str = NET
    others: dict[str, str] = field(default_factory=dict)  # further files


def solver(*faults: str, more: str = "", less: str = "", **rest: Any) -> Case:
    assert less in SOLVER
    return Case(list(faults), SOLVER.replace(less, "") + more, **rest)


def net(*faults: str, old: str = "", new: str = "", **rest: Any) -> Case:
    assert old in NET
    return Case(list(faults), net=NET.replace(old, new) if old else new, **rest)


def filled(filler: str, *faults: str) -> Case:
    return net(*faults, old='weight_filler { type: "xavier" }', new=f"weight_filler {{ {filler} }}")


def reads(kind: str, own: str, *faults: str, **rest: Any) -> Case:
    return Case(list(faults), net=READS % (kind, own), **rest)


GONE = "make sure that the directory exists and is writeable"
SETTINGS = {
    "several settings": solver(
        's.prototxt:6:1: unknown solver type "Adan", expected one of SGD, ',
        's.prototxt:7:1: unknown lr_policy "stp", expected one of fixed, ',
        's.prototxt:8:1: unknown regularization_type "L3", expected L2 or L1',
        "s.prototxt:9:1: found iter_size 0, expected at least 1",
        "s.prototxt:10:1: found test_iter -1, expected at least 0",
        "s.prototxt: found test_interval 0, expected more than 0",
        more='type: "Adan"\nlr_policy: "stp"\nregularization_type: "L3"\niter_size: 0\ntest_iter: -1\n',
        less='lr_policy: "fixed"\n',
    ),
    "all that a policy lacks": solver(
        's.prototxt:6:1: lr_policy "step" needs gamma, found none',
        's.prototxt:6:1: lr_policy "step" needs stepsize, found none',
        more='lr_policy: "step"',
        less='lr_policy: "fixed"\n',
    ),
    "all that a policy cannot use": solver(
        's.prototxt:7:1: lr_policy "step" needs gamma of at least 0, found -1',
        's.prototxt:8:1: lr_policy "step" needs stepsize of more than 0, found 0',
        more='lr_policy: "step"\ngamma: -1\nstepsize: 0',
        less='lr_policy: "fixed"\n',
    ),
    "a rule": solver(
        "s.prototxt:8:1: momentum cannot be used with RMSProp; remove it",
        "s.prototxt:9:1: rms_decay 1, expected at least 0 and less than 1",
        more='type: "RMSProp"\nmomentum: 0.9\nrms_decay: 1',
    ),
    "a prefix in no folder": solver(
        f's.prototxt:8:1: cannot write to snapshot prefix "gone/x": No such file or directory; {GONE}',
        more='snapshot: 1\nsnapshot_prefix: "gone/x"',
    ),
    "a prefix in no folder for the last snapshot": solver(
        f's.prototxt:6:1: cannot write to snapshot prefix "gone/x": No such file or directory; {GONE}',
        more='snapshot_prefix: "gone/x"',
        less="snapshot_after_train: false\n",
    ),
    "a prefix below a file": solver(
        f's.prototxt:8:1: cannot write to snapshot prefix "net.prototxt/x": Not a directory; {GONE}',
        more='snapshot: 1\nsnapshot_prefix: "net.prototxt/x"',
    ),
    "no net": solver("s.prototxt: the solver has no net to train, expected", less='net: "net.prototxt"\n'),
    "files that are missing or broken": Case(
        [
            's.prototxt:1:1: net "gone.prototxt" is not a file; paths are relative',
            'broken.prototxt:1:28: layer "a" (ReLU): expected',
            's.prototxt:3:1: test_net "missing.prototxt" is not a file',
            "s.prototxt:4:1: found 1 test_iter, expected 2, one for each",
        ],
        'net: "gone.prototxt"\ntest_net: "broken.prototxt"\ntest_net: "missing.prototxt"\n'
        'test_iter: 1 test_interval: 1 lr_policy: "fixed"',
        others={"broken.prototxt": 'layer{ name:"a"type:"ReLU" 7 }'},
    ),
    "test_state": solver(
        "s.prototxt:9:1: found 2 test_state, expected none or one for each of the 1 test nets",
        more=TESTED + "test_state { } test_state { }",
    ),
}
FILLERS = {
    "two unknown fillers": net(
        f'net.prototxt:5:5: {IP}unknown filler "xaviar"; did you mean "xavier"?',
        f'net.prototxt:6:5: {IP}unknown filler "konstant"; did you mean "constant"?',
        old=PRODUCT,
        new=PRODUCT.replace("xavier", "xaviar").replace('"constant"', '"konstant"'),
    ),
    "the same twice": net(
        f'net.prototxt:5:5: {IP}unknown filler "x"; known: ',
        f'net.prototxt:6:5: {IP}unknown filler "x"; known: ',
        old=PRODUCT,
        new=PRODUCT.replace("xavier", "x").replace('"constant"', '"x"'),
    ),
    "gaussian": filled('type: "gaussian" std: 0', f'net.prototxt:5:5: {IP}filler "gaussian" needs std > 0, found 0'),
    "sparse below none": filled('type: "gaussian" sparse: -2', f'net.prototxt:5:5: {IP}filler "gaussian" needs sparse'),
    "too sparse": filled(
        'type: "gaussian" sparse: 3', f'net.prototxt:5:5: {IP}filler "gaussian" needs sparse <= shape[0] = 2, found 3'
    ),
    "sparse without sense": filled(
        'type: "xavier" sparse: 1', f'net.prototxt:5:5: {IP}filler "xavier" does not support sparse (found 1)'
    ),
    "uniform": filled('type: "uniform" min: 2', f'net.prototxt:5:5: {IP}filler "uniform" needs min <= max'),
    "bilinear": filled('type: "bilinear"', f'net.prototxt:5:5: {IP}filler "bilinear" needs a 4-D blob with square'),
    "empty blobs": net(
        'net.prototxt:1:48: layer "no" (DummyData): cannot fill an empty blob of shape (4, 0)',
        f"net.prototxt:5:5: {IP}cannot fill an empty blob of shape (2, 0)",
        'net.prototxt:1:95: layer "in" (Input): nothing fills "data" and "label" during training; ',
        new='layer { name: "no" type: "DummyData" top: "no" dummy_data_param { shape { dim: 4 dim: 0 } } } '
        + INPUT.replace("dim: 3", "dim: 0")
        + "\n"
        + PRODUCT,
    ),
    "dummy data": net(
        'net.prototxt:2:70: layer "data" (DummyData): unknown filler "gausian"; did you mean',
        'net.prototxt:2:102: layer "data" (DummyData): filler "uniform" needs min <= max',
        old="dim: 2 } }",
        new='dim: 2 } data_filler { type: "gausian" } data_filler { type: "uniform" min: 3 } }',
    ),
    "a scalar": net(
        'net.prototxt:9:43: layer "p" (PReLU): filler "xavier" needs a blob of at least one axis, found a scalar',
        new=NET + 'layer { name: "p" type: "PReLU" bottom: "ip" top: "p"\n prelu_param { channel_shared: true       '
        'filler { type: "xavier" } } }',
    ),
}
NETS = {
    "a type and a bottom": net(
        'net.prototxt:7:57: layer "loss" (EuclidianLoss): unknown bottom blob "labels"; did you mean "label"?',
        'net.prototxt:3:20: layer "ip" (InnerProdukt): unknown layer type "InnerProdukt"; did you mean',
        'net.prototxt:7:22: layer "loss" (EuclidianLoss): unknown layer type "EuclidianLoss"; did you mean',
        new=NET.replace("InnerProduct", "InnerProdukt")
        .replace('bottom: "label"', 'bottom: "labels"')
        .replace("EuclideanLoss", "EuclidianLoss"),
    ),
    "include and exclude": net(
        'net.prototxt:7:110: layer "loss" (EuclideanLoss): found both include and exclude rules',
        old='top: "loss" }',
        new='top: "loss" include { phase: TRAIN } exclude { phase: TEST } }',
    ),
    "a blob twice": net(
        'net.prototxt:7:44: layer "loss" (EuclideanLoss): unknown bottom blob "ip"; available: data, label',
        f'net.prototxt:3:56: {IP}top blob "label" is produced by multiple sources (first by layer "data")',
        old='top: "ip"',
        new='top: "label"',
    ),
    "propagate_down": net(
        'net.prototxt:7:85: layer "loss" (EuclideanLoss): found 1 propagate_down, expected 0 or 2',
        old='top: "loss" }',
        new='top: "loss" propagate_down: true }',
    ),
    "too many params, and of a loss weight two": net(
        f"net.prototxt:3:86: {IP}found 3 param {{ }}, expected at most 2",
        'net.prototxt:7:85: layer "loss" (EuclideanLoss): found 2 loss_weight, expected none or one',
        new=NET.replace("param { lr_mult: 1 }", "param { } param { } param { }").replace(
            'top: "loss" }', 'top: "loss" loss_weight: 1 loss_weight: 1 }'
        ),
    ),
    "a faulty loss weight hides nothing behind it": net(
        f"net.prototxt:3:66: {IP}found 2 loss_weight, expected none or one",
        'net.prototxt:7:44: layer "loss" (EuclideanLoss): found bottoms of shapes',
        new=NET.replace("param { lr_mult: 1 }", "loss_weight: 0 loss_weight: 0").replace("dim: 2", "dim: 5"),
    ),
    "params that cannot be shared": net(
        'net.prototxt:8:70: layer "ip2" (InnerProduct): cannot share param "w" owned by layer "ip", param index 0: ',
        'net.prototxt:8:90: layer "ip2" (InnerProduct): cannot share param "b" owned by layer "ip", param index 1: ',
        new=NET.replace("param { lr_mult: 1 }", 'param { name: "w" } param { name: "b" }')
        + 'layer { name: "ip2" type: "InnerProduct" bottom: "label" top: "more" param { name: "w" } param { name: "b" }'
        " inner_product_param { num_output: 7 } }",
    ),
    "multipliers that differ": net(
        'net.prototxt:8:87: layer "ip2" (InnerProduct): shared param "w" has lr_mult 3 here and 1 before',
        new=NET.replace("param { lr_mult: 1 }", 'param { name: "w" lr_mult: 1 }')
        + 'layer { name: "ip2" type: "InnerProduct" bottom: "data" top: "more" param { name: "w" lr_mult: 3 } '
        "inner_product_param { num_output: 2 } }",
    ),
    "blobs in the prototxt": net(
        "net.prototxt: cannot copy param 0 weights from layer 'ip'; shape mismatch. Source param shape is 1 (1)",
        new=NET.replace(
            "param { lr_mult: 1 }", "blobs { shape { dim: 1 } data: 1 } blobs { shape { dim: 2 } data: [1, 2] }"
        ),
    ),
    "a blob beyond all memory": net(
        f"net.prototxt:3:1: {IP}found shape (1000000000, 3), 3,000,000,000 numbers, expected at most 2,147,483,647",
        old="num_output: 2",
        new="num_output: 1000000000",
    ),
    "bottoms and tops": net(
        'net.prototxt:7:44: layer "loss" (EuclideanLoss): found 1 bottom blob(s), expected 2',
        'net.prototxt:7:57: layer "loss" (EuclideanLoss): found 2 top blob(s), expected 1',
        old='bottom: "ip" bottom: "label" top: "loss"',
        new='bottom: "ip" top: "loss" top: "more"',
    ),
    "an output that cannot be written": net(
        'net.prototxt:8:93: layer "o" (HDF5Output): HDF5 file "gone/o.h5" cannot be written: No such file or directory',
        new=NET + 'layer { name: "o" type: "HDF5Output" bottom: "ip" bottom: "label" hdf5_output_param {       '
        'file_name: "gone/o.h5" } }',
    ),
    "a Python layer without leave": net(
        'net.prototxt:8:20: layer "py" (Python): a Python layer runs code named in the prototxt',
        new=NET + 'layer { name: "py" type: "Python" bottom: "ip" top: "py" python_param { module: "m" layer: "L" } }',
    ),
}
FEEDS = {
    "a training net that nobody feeds": net(
        'net.prototxt:1:1: layer "in" (Input): nothing fills "data" and "label" during training; ',
        new=INPUT + PRODUCT.replace("num_output: 2", "num_output: 3") + LOSS,
    ),
    "arrays that nobody gives": net(
        'net.prototxt:1:1: layer "d" (MemoryData): has no data yet; call set_input_arrays',
        new=READS % ("MemoryData", "memory_data_param { batch_size: 2 channels: 1 height: 1 width: 3 }"),
    ),
    "a test net that nobody feeds, of other shapes": Case(
        [
            'test.prototxt:2:1: layer "ip" (InnerProduct): cannot share weights with the training net: shapes',
            'test.prototxt:1:1: layer "in" (Input): nothing fills "data" and "label" during training; ',
        ],
        SOLVER + 'test_net: "test.prototxt"\n' + TESTED,
        others={"test.prototxt": INPUT + PRODUCT.replace("num_output: 2", "num_output: 3") + LOSS},
    ),
}
WEIGHTS = {
    "weights that are missing": solver(
        "gone.caffemodel: cannot be read: No such file or directory",
        "gone.caffemodel.h5: cannot be read: No such file or directory",
        more='weights: "gone.caffemodel, gone.caffemodel.h5"',
    ),
    "weights of other shapes": solver(
        "other.caffemodel: cannot copy param 0 weights from layer 'ip'; shape mismatch. Source param shape is 3 5 (15)",
        "other.caffemodel: cannot copy param 1 weights from layer 'ip'; shape mismatch. Source param shape is 3 (3)",
        more='weights: "other.caffemodel"',
    ),
    "weights of other shapes in HDF5": solver(
        "other.caffemodel.h5: cannot copy param 0 weights from layer 'ip'; shape mismatch. Source param shape is 3 5",
        "other.caffemodel.h5: cannot copy param 1 weights from layer 'ip'; shape mismatch. Source param shape is 3 (3)",
        more='weights: "other.caffemodel.h5"',
    ),
    "weights of another number": solver(
        "other.caffemodel: incompatible number of blobs for layer 'ip': 2 in the file, 1 in the net. ",
        more='weights: "other.caffemodel"',
        net=NET.replace("num_output: 2", "num_output: 2 bias_term: false"),
    ),
    "weights that are none": solver(
        "net.prototxt: ", "cut.caffemodel.h5: cannot be read", more='weights: "net.prototxt,cut.caffemodel.h5"'
    ),
}
LMDB = "backend: LMDB"
TRANSFORM = 'force_color: true force_gray: true mean_value: 1 mean_file: "m"'
READERS = {
    "Data": reads(
        "Data",
        "data_param { batch_size: 0 } transform_param { " + TRANSFORM + " }",
        'net.prototxt:2:16: layer "d" (Data): batch_size must be above 0, found 0',
        'net.prototxt:2:3: layer "d" (Data): source is missing; set it to the path of the data',
        'net.prototxt:2:68: layer "d" (Data): force_color and force_gray cannot both be set',
        'net.prototxt:2:85: layer "d" (Data): mean_file and mean_value cannot both be set',
    ),
    "ImageData": reads(
        "ImageData",
        "image_data_param { new_height: 3 } transform_param { " + TRANSFORM + " }",
        'net.prototxt:2:3: layer "d" (ImageData): new_height and new_width must be given together',
        'net.prototxt:2:3: layer "d" (ImageData): source is missing; set it to the path of the data',
        'net.prototxt:2:74: layer "d" (ImageData): force_color and force_gray cannot both be set',
        'net.prototxt:2:91: layer "d" (ImageData): mean_file and mean_value cannot both be set',
    ),
    "HDF5Data": reads(
        "HDF5Data",
        "hdf5_data_param { } transform_param { scale: 2 }",
        'net.prototxt:2:3: layer "d" (HDF5Data): batch_size must be above 0, found 0',
        'net.prototxt:2:3: layer "d" (HDF5Data): source is missing; set it to the path of the data',
        'net.prototxt:2:23: layer "d" (HDF5Data): HDF5Data does not transform data; remove transform_param',
    ),
    "WindowData": reads(
        "WindowData",
        'window_data_param { batch_size: 4 crop_mode: "round" context_pad: 4 } transform_param { crop_size: 8 '
        "mean_value: 1 mean_value: 2 }",
        'net.prototxt:2:3: layer "d" (WindowData): source is missing; set it to the path of the data',
        'net.prototxt:2:37: layer "d" (WindowData): unknown crop_mode "round"; expected warp or square',
        'net.prototxt:2:56: layer "d" (WindowData): context_pad 4 on both sides leaves nothing of crop_size 8',
        'net.prototxt:2:104: layer "d" (WindowData): found 2 mean_value, expected 1 or 3',
    ),
}
PLACE = 'net.prototxt:2:16: layer "d" (Data): '
FOUND_IN_DATA = {
    "databases of two nets, and a mean": Case(
        [
            f'{PLACE}database "gone" does not exist',
            'net.prototxt:2:79: layer "d" (Data): mean file "gone" cannot be read: No such file or directory',
            'test.prototxt:2:16: layer "d" (Data): database "empty_lmdb" is empty: it contains no records',
        ],
        SOLVER + 'test_net: "test.prototxt"\n' + TESTED,
        READS
        % ("Data", f'data_param {{ source: "gone" {LMDB} batch_size: 1 }} transform_param {{ mean_file: "gone" }}'),
        others={"test.prototxt": READS % ("Data", f'data_param {{ source: "empty_lmdb" {LMDB} batch_size: 1 }}')},
    ),
    "a mean of another size": reads(
        "Data",
        f'data_param {{ source: "db" {LMDB} batch_size: 1 }} transform_param {{ mean_file: "mean.binaryproto" }}',
        'net.prototxt:2:77: layer "d" (Data): the mean of "mean.binaryproto" has shape 3 x 9 x 9, the image before',
    ),
    "a crop that does not fit": reads(
        "Data",
        f'data_param {{ source: "db" {LMDB} batch_size: 1 }} transform_param {{ crop_size: 7 }}',
        'net.prototxt:2:77: layer "d" (Data): crop_size 7 is larger than the image, 3 x 6 x 8',
    ),
    "means that do not fit": reads(
        "Data",
        f'data_param {{ source: "db" {LMDB} batch_size: 1 }} transform_param {{ mean_value: 7 mean_value: 8 }}',
        'net.prototxt:2:77: layer "d" (Data): found 2 mean_value for 3 channels, expected 1 or 3',
    ),
    "a skip beyond the end": reads(
        "Data",
        f'data_param {{ source: "db" {LMDB} batch_size: 1 rand_skip: 1000000 }}',
        'net.prototxt:2:57: layer "d" (Data): cannot skip',
        solver=SOLVER + "random_seed: 5",
    ),
    "the other backend": reads(
        "Data", 'data_param { source: "db" batch_size: 1 }', f'{PLACE}database "db" has backend LMDB, not LEVELDB'
    ),
    "a shape that does not suit the net": Case(
        ['net.prototxt:3:67: layer "loss" (EuclideanLoss): found bottoms of shapes (2, 3, 6, 8) and (2,), expected'],
        net=f"""layer {{ name: "d" type: "Data" top: "data" top: "label"
  data_param {{ source: "db" {LMDB} batch_size: 2 }} }}
layer {{ name: "loss" type: "EuclideanLoss"                        bottom: "data" bottom: "label" top: "loss" }}
""",
    ),
    "a list that is missing, and a mean": reads(
        "ImageData",
        'image_data_param { source: "gone.txt" } transform_param { mean_file: "gone" }',
        'net.prototxt:2:22: layer "d" (ImageData): list file "gone.txt" cannot be read: No such file or directory',
        'net.prototxt:2:61: layer "d" (ImageData): mean file "gone" cannot be read: No such file or directory',
    ),
    "an empty list": reads(
        "ImageData",
        'image_data_param { source: "empty.txt" }',
        'net.prototxt:2:22: layer "d" (ImageData): the image list "empty.txt" is empty',
    ),
    "a list without labels": reads(
        "ImageData",
        'image_data_param { source: "names.txt" }',
        'names.txt:1:1: found "0.png", expected an image name, a space and an integer label',
    ),
    "a first image that is missing": reads(
        "ImageData",
        'image_data_param { source: "nix.txt" }',
        'nix.txt:1:1: image "nix.png" cannot be read: No such file or directory',
    ),
    "no list of HDF5 files": reads(
        "HDF5Data",
        'hdf5_data_param { source: "gone.txt" batch_size: 1 }',
        'net.prototxt:2:21: layer "d" (HDF5Data): list file "gone.txt" cannot be read: No such file or directory',
    ),
    "an HDF5 file that is missing": reads(
        "HDF5Data",
        'hdf5_data_param { source: "names.txt" batch_size: 1 }',
        'names.txt:1:1: HDF5 file "0.png" cannot be read: ',
    ),
    "an HDF5 file without a top": reads(
        "HDF5Data",
        'hdf5_data_param { source: "rows.txt" batch_size: 1 }',
        'rows.txt:1:1: HDF5 file "rows.h5" has no dataset "label", the name of a top; it has "data"',
    ),
    "no window file, and a mean": reads(
        "WindowData",
        'window_data_param { source: "gone.txt" batch_size: 1 } transform_param { crop_size: 4 mean_file: "gone" }',
        'net.prototxt:2:23: layer "d" (WindowData): window file "gone.txt" cannot be read: ',
        'net.prototxt:2:89: layer "d" (WindowData): mean file "gone" cannot be read: No such file or directory',
    ),
    "a broken window file": reads(
        "WindowData",
        'window_data_param { source: "names.txt" batch_size: 1 } transform_param { crop_size: 4 }',
        'names.txt:1:1: found "0.png", expected "# 0", the number of the next image',
    ),
    "no infogain matrix": net(
        'net.prototxt:3:96: layer "loss" (InfogainLoss): cannot read the infogain matrix "gone" (a binary BlobProto',
        new=DATA.replace("dim: 4 dim: 2", "dim: 4")
        + 'layer { name: "loss" type: "InfogainLoss" bottom: "data" bottom: "label" '
        'infogain_loss_param { source: "gone" } }',
    ),
    "an infogain matrix of another size": net(
        'net.prototxt:3:96: layer "loss" (InfogainLoss): found an infogain matrix of shape (1, 3, 9, 9), expected ',
        new=DATA.replace("dim: 4 dim: 2", "dim: 4")
        + 'layer { name: "loss" type: "InfogainLoss" bottom: "data" bottom: "label" '
        'infogain_loss_param { source: "mean.binaryproto" } }',
    ),
}
CASES = SETTINGS | FILLERS | NETS | FEEDS | WEIGHTS | READERS


@pytest.fixture
def files(run: Run) -> None:
    """Small data, sound and unsound, in the working directory."""
    lmdb.open("empty_lmdb").close()
    with Writer("db") as writer:
        for i in range(3):
            writer.put(b"%d" % i, array_to_datum(np.zeros((3, 6, 8), np.uint8)).SerializeToString())
    write_mean("mean.binaryproto", np.zeros((3, 9, 9), np.float32))
    cv2.imwrite("0.png", np.zeros((6, 8, 3), np.uint8))
    Path("empty.txt").write_text("# nothing\n")
    Path("names.txt").write_text("0.png\n")
    Path("nix.txt").write_text("nix.png 0\n0.png 0\n")
    Path("rows.txt").write_text("rows.h5\n")
    with h5py.File("rows.h5", "w") as file:
        file["data"] = np.zeros((3, 2))
    other = netspec.proto.schema.NetParameter()
    layer = other.layer.add(name="ip")
    layer.blobs.extend([from_array(np.zeros((3, 5), np.float32)), from_array(np.zeros(3, np.float32))])
    Path("other.caffemodel").write_bytes(other.SerializeToString())
    with h5py.File("other.caffemodel.h5", "w") as file:
        file["data/ip/0"], file["data/ip/1"] = np.zeros((3, 5)), np.zeros(3)
    Path("cut.caffemodel.h5").write_bytes(Path("other.caffemodel.h5").read_bytes()[:1000])


def write(case: Case) -> None:
    Path("s.prototxt").write_text(case.solver)
    for name, text in {"net.prototxt": case.net, **case.others}.items():
        Path(name).write_text(text)


def without_warnings(text: str) -> list[str]:
    return [line for line in text.splitlines() if not line.startswith("warning: ")]


def begin_with(lines: list[str], beginnings: list[str]) -> bool:
    return len(lines) == len(beginnings) and all(map(str.startswith, lines, beginnings))


@pytest.mark.slow
@pytest.mark.usefixtures("files")
@pytest.mark.parametrize("case", [*CASES.values(), *FOUND_IN_DATA.values()], ids=[*CASES, *FOUND_IN_DATA])
def test_check_reports_at_once_what_train_refuses(run: Run, case: Case) -> None:
    write(case)
    before = sorted(Path().rglob("*"))
    found = run("check", "s.prototxt", "--data")
    lines = without_warnings(found.err)
    assert (found.status, found.out) == (1, "")
    assert begin_with(lines, case.faults), found.err
    assert sorted(Path().rglob("*")) == before
    trained = run("train", "s.prototxt")
    assert trained.fault in lines
    assert not any(message.startswith("Iteration ") for message in trained.messages)


@pytest.mark.slow
@pytest.mark.usefixtures("files")
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_check_needs_no_data_for_the_faults_of_prototxts(run: Run, case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    write(case)
    for opens in ("layers.data.files.open_reader", "layers.data.files.read_image_list", "data.transformer.read_mean"):
        monkeypatch.setattr(f"netspec.{opens}", lambda *_: pytest.fail("data was opened"))
    assert begin_with(without_warnings(run("check", "s.prototxt").err), case.faults)


SHAPES = {
    "HDF5Data": ["--shape", "data=1,2", "--shape", "label=1"],
    "Data": ["--shape", "data=1,3,6,8"],
    "ImageData": ["--shape", "data=1,3,6,8"],
}


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize("name", FOUND_IN_DATA)
def test_check_opens_data_only_where_it_is_told_to(run: Run, name: str) -> None:
    case = FOUND_IN_DATA[name]
    write(case)
    shutil.rmtree("db")
    words = next((words for kind, words in SHAPES.items() if f'type: "{kind}"' in case.net), [])
    if name != "a shape that does not suit the net":
        assert run("check", "s.prototxt", *words).status == 0


def test_weights_can_be_checked_against_a_net_or_a_solver(run: Run, files: None) -> None:
    write(Case([]))
    for file in ("net.prototxt", "s.prototxt"):
        assert run("check", file).status == 0
        lines = run("check", file, "--weights", "other.caffemodel,gone.caffemodel").err.splitlines()
        lines = [line for line in lines if not line.startswith("warning:")]
        assert [line.partition(" ")[0] for line in lines] == ["other.caffemodel:"] * 2 + ["gone.caffemodel:"]
    Path("s.prototxt").write_text(SOLVER + 'weights: "gone.caffemodel"')
    assert "other" not in run("check", "s.prototxt").err
    assert "gone" not in run("check", "s.prototxt", "--weights", "other.caffemodel").err  # as train --weights


def test_a_shape_stands_for_the_data_of_its_layer(run: Run, files: None) -> None:
    write(reads("Data", f'data_param {{ source: "gone" {LMDB} batch_size: 2 }}'))
    assert run("check", "s.prototxt", "--data").status == 1
    assert run("check", "s.prototxt", "--data", "--shape", "data=2,3,6,8").status == 0


def test_data_says_the_shapes_that_it_has(run: Run, files: None) -> None:
    write(reads("Data", f'data_param {{ source: "db" {LMDB} batch_size: 2 }}'))
    result = run("check", "net.prototxt", "--data")
    assert result.status == 0
    assert "2x3x6x8, 2" in result.out

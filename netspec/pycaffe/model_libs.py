"""Parts of nets that SSD's scripts put together: the bodies of VGG, ZF, ResNet and Inception, and SSD's heads.

Each function adds layers to a NetSpec under the names that SSD's trained weights have. ``bn_param`` are eps,
moving_average_fraction and use_global_stats of the BatchNorm layers. SSD's own layers (Permute, Normalize, PriorBox,
AnnotatedData) need its dialect: ``netspec run --plugin ssd script.py``.
Fork: python/caffe/model_libs.py of weiliu89/caffe, branch ssd
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import netspec.pycaffe as caffe  # noqa: F401 (scripts take it from here by import *)
from netspec.pycaffe.net_spec import NetSpec, Top
from netspec.pycaffe.net_spec import layers as L
from netspec.pycaffe.net_spec import params as P
from netspec.pycaffe.proto import caffe_pb2

Sizes = Sequence[Any]
_FROZEN = [{"lr_mult": 0, "decay_mult": 0}] * 2
_CONVOLUTION = {
    "param": [{"lr_mult": 1, "decay_mult": 1}, {"lr_mult": 2, "decay_mult": 0}],
    "weight_filler": {"type": "xavier"},
    "bias_filler": {"type": "constant", "value": 0},
}


def check_if_exist(path: str) -> bool:
    """Say whether there is a file or folder."""
    return os.path.exists(path)


def make_if_not_exist(path: str) -> None:
    """Make a folder, unless it is there."""
    os.makedirs(path, exist_ok=True)


def UnpackVariable(var: Any, num: int) -> list[Any]:
    """Return ``num`` values: the list itself where it has as many, else its one value, or the value, repeated."""
    if isinstance(var, list) and len(var) == num:
        return var
    if isinstance(var, list):
        (var,) = var
    return [var] * num


# ---- Blocks ----


def ConvBNLayer(
    net: NetSpec,
    from_layer: str,
    out_layer: str,
    use_bn: bool,
    use_relu: bool,
    num_output: int,
    kernel_size: Any,
    pad: Any,
    stride: Any,
    dilation: int = 1,
    use_scale: bool = True,
    lr_mult: float = 1,
    conv_prefix: str = "",
    conv_postfix: str = "",
    bn_prefix: str = "",
    bn_postfix: str = "_bn",
    scale_prefix: str = "",
    scale_postfix: str = "_scale",
    bias_prefix: str = "",
    bias_postfix: str = "_bias",
    **bn_params: Any,
) -> None:
    """Add a convolution; with ``use_bn`` BatchNorm and Scale (or Bias) behind it; with ``use_relu`` a ReLU."""
    if use_bn:
        options: dict[str, Any] = {
            "param": [{"lr_mult": lr_mult, "decay_mult": 1}],
            "weight_filler": {"type": "gaussian", "std": 0.01},
            "bias_term": False,
        }
    else:
        rates = [{"lr_mult": lr_mult, "decay_mult": 1}, {"lr_mult": 2 * lr_mult, "decay_mult": 0}]
        options = {**_CONVOLUTION, "param": rates}
    name = f"{conv_prefix}{out_layer}{conv_postfix}"
    (kernel_h, kernel_w), (pad_h, pad_w), (stride_h, stride_w) = (
        UnpackVariable(value, 2) for value in (kernel_size, pad, stride)
    )
    if kernel_h == kernel_w:
        window = {"kernel_size": kernel_h, "pad": pad_h, "stride": stride_h}
    else:
        window = {"kernel_h": kernel_h, "kernel_w": kernel_w, "pad_h": pad_h, "pad_w": pad_w}
        window |= {"stride_h": stride_h, "stride_w": stride_w}
    net[name] = L.Convolution(net[from_layer], num_output=num_output, **window, **options)
    if dilation > 1:
        net.update(name, {"dilation": dilation})
    if use_bn:
        bn_name = f"{bn_prefix}{out_layer}{bn_postfix}"
        learned = 0 if bn_params.get("use_global_stats") else lr_mult
        net[bn_name] = L.BatchNorm(net[name], in_place=True, **_statistics(bn_params))
        rate = {"lr_mult": learned, "decay_mult": 0}
        zero = {"type": "constant", "value": 0.0}
        if use_scale:
            one = {"type": "constant", "value": 1.0}
            scale: dict[str, Any] = {"bias_term": True, "param": [rate, rate], "filler": one, "bias_filler": zero}
            net[f"{scale_prefix}{out_layer}{scale_postfix}"] = L.Scale(net[bn_name], in_place=True, **scale)
        else:
            shift: dict[str, Any] = {"param": [rate], "filler": zero}
            net[f"{bias_prefix}{out_layer}{bias_postfix}"] = L.Bias(net[bn_name], in_place=True, **shift)
    if use_relu:
        net[f"{name}_relu"] = L.ReLU(net[name], in_place=True)


def _statistics(bn_params: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a BatchNorm layer: its statistics are never learned."""
    options: dict[str, Any] = {"param": [{"lr_mult": 0, "decay_mult": 0}] * 3, "eps": bn_params.get("eps", 0.001)}
    if bn_params.get("use_global_stats"):
        return {**options, "use_global_stats": True}
    return {**options, "moving_average_fraction": bn_params.get("moving_average_fraction", 0.999)}


def ResBody(
    net: NetSpec,
    from_layer: str,
    block_name: str,
    out2a: int,
    out2b: int,
    out2c: int,
    stride: int,
    use_branch1: bool,
    dilation: int = 1,
    **bn_param: Any,
) -> None:
    """Add a residual block ``res<block_name>``: 1x1, 3x3 and 1x1 convolutions; a 1x1 beside them with use_branch1."""
    names: dict[str, Any] = {"conv_prefix": f"res{block_name}_", "bn_prefix": f"bn{block_name}_", "bn_postfix": ""}
    names |= {"scale_prefix": f"scale{block_name}_", "scale_postfix": ""}

    def add(source: str, branch: str, relu: bool, **options: Any) -> str:
        ConvBNLayer(net, source, branch, use_bn=True, use_relu=relu, **options, **names, **bn_param)
        return f"res{block_name}_{branch}"

    shortcut = from_layer
    if use_branch1:
        shortcut = add(from_layer, "branch1", False, num_output=out2c, kernel_size=1, pad=0, stride=stride)
    first = add(from_layer, "branch2a", True, num_output=out2a, kernel_size=1, pad=0, stride=stride)
    wide: dict[str, Any] = {"kernel_size": 3, "pad": dilation, "stride": 1, "dilation": dilation}
    second = add(first, "branch2b", True, num_output=out2b, **wide)
    third = add(second, "branch2c", False, num_output=out2c, kernel_size=1, pad=0, stride=1)
    net[f"res{block_name}"] = L.Eltwise(net[shortcut], net[third])
    net[f"res{block_name}_relu"] = L.ReLU(net[f"res{block_name}"], in_place=True)


def InceptionTower(
    net: NetSpec, from_layer: str, tower_name: str, layer_params: Sequence[Mapping[str, Any]], **bn_param: Any
) -> Top:
    """Add layers one behind the other; each has a name and the parameters of ConvBNLayer, or of Pooling."""
    for given in layer_params:
        name = f"{tower_name}/{given['name']}"
        options = {key: value for key, value in given.items() if key != "name"}
        if "pool" in name:
            net[name] = L.Pooling(net[from_layer], **options)
        else:
            ConvBNLayer(net, from_layer, name, use_bn=True, use_relu=True, use_scale=False, **{**options, **bn_param})
        from_layer = name
    return net[from_layer]


# ---- Data ----


def CreateAnnotatedDataLayer(
    source: str,
    batch_size: int = 32,
    backend: int = P.Data.LMDB,
    output_label: bool = True,
    train: bool = True,
    label_map_file: str = "",
    anno_type: int | None = None,
    transform_param: Mapping[str, Any] | None = None,
    batch_sampler: Sequence[Mapping[str, Any]] = ({},),
) -> Any:
    """Return the tops of an AnnotatedData layer. (netspec writes such layers; it does not run them.)"""
    annotated: dict[str, Any] = {"label_map_file": label_map_file, "batch_sampler": list(batch_sampler)}
    if anno_type is not None:
        annotated["anno_type"] = anno_type
    return L.AnnotatedData(
        name="data",
        annotated_data_param=annotated,
        data_param={"batch_size": batch_size, "backend": backend, "source": source},
        ntop=2 if output_label else 1,
        include={"phase": caffe_pb2.TRAIN if train else caffe_pb2.TEST},
        transform_param=dict(transform_param or {}),
    )


# ---- Bodies ----


def ZFNetBody(
    net: NetSpec,
    from_layer: str,
    need_fc: bool = True,
    fully_conv: bool = False,
    reduced: bool = False,
    dilated: bool = False,
    dropout: bool = True,
    need_fc8: bool = False,
    freeze_layers: Sequence[str] = (),
) -> NetSpec:
    """Add the net of Zeiler and Fergus up to conv5, with ``need_fc`` up to fc7, with ``need_fc8`` up to prob."""
    assert from_layer in net.keys()  # noqa: SIM118 (a NetSpec is no dict)
    below = net[from_layer]
    for number, outputs, pad, kernel in ((1, 96, 3, 7), (2, 256, 2, 5)):
        below = _convolution(net, f"conv{number}", f"relu{number}", below, outputs, pad, kernel, stride=2)
        local: dict[str, Any] = {"local_size": 3, "alpha": 0.00005, "beta": 0.75, "engine": P.LRN.CAFFE}
        net[f"norm{number}"] = L.LRN(below, norm_region=P.LRN.WITHIN_CHANNEL, **local)
        below = net[f"pool{number}"] = _max_pool(net[f"norm{number}"], 3, 2, pad=1)
    for number, outputs in ((3, 384), (4, 384), (5, 256)):
        below = _convolution(net, f"conv{number}", f"relu{number}", below, outputs, 1, 3)
    if need_fc:
        net.pool5 = _max_pool(below, 3, 1 if dilated else 2, pad=1)
        if not fully_conv:
            window: dict[str, int] = {}
        elif reduced:
            window = (
                {"pad": 5, "kernel_size": 3, "dilation": 5} if dilated else {"pad": 2, "kernel_size": 3, "dilation": 2}
            )
        else:
            window = {"pad": 5, "kernel_size": 6, "dilation": 2} if dilated else {"pad": 2, "kernel_size": 6}
        _fully_connected(net, net.pool5, window, reduced, dropout)
    if need_fc8:
        last = net[net.keys()[-1]]
        net.fc8 = (
            L.Convolution(last, num_output=1000, kernel_size=1, **_CONVOLUTION)
            if fully_conv
            else L.InnerProduct(last, num_output=1000)
        )
        net.prob = L.Softmax(net.fc8)
    return _freeze(net, freeze_layers)


def VGGNetBody(
    net: NetSpec,
    from_layer: str,
    need_fc: bool = True,
    fully_conv: bool = False,
    reduced: bool = False,
    dilated: bool = False,
    nopool: bool = False,
    dropout: bool = True,
    freeze_layers: Sequence[str] = (),
    dilate_pool4: bool = False,
) -> NetSpec:
    """Add VGG's 16 layers up to conv5_3, with ``need_fc`` up to fc7: InnerProducts, or convolutions with fully_conv.

    ``reduced`` makes fc6 and fc7 smaller, ``dilated`` keeps pool5's stride at 1, ``nopool`` has convolutions for pools.
    """
    assert from_layer in net.keys()  # noqa: SIM118 (a NetSpec is no dict)
    below, dilation = net[from_layer], 1
    for stage, (outputs, count) in enumerate(((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)), 1):
        for number in range(1, count + 1):
            name = f"{stage}_{number}"
            spread = {"dilation": dilation} if stage == 5 else {}
            below = _convolution(net, f"conv{name}", f"relu{name}", below, outputs, dilation, 3, **spread)
        if stage == 5:
            break
        if nopool:
            name = f"conv{stage}_{count + 1}"
            net[name] = L.Convolution(below, num_output=outputs, pad=1, kernel_size=3, stride=2, **_CONVOLUTION)
        elif stage == 4 and dilate_pool4:
            name, dilation = "pool4", 2
            net[name] = _max_pool(below, 3, 1, pad=1)
        else:
            name = f"pool{stage}"
            net[name] = _max_pool(below, 2, 2)
        below = net[name]
    if need_fc:
        if nopool:
            stride = 1 if dilated else 2
            below = net.conv5_4 = L.Convolution(
                below, num_output=512, pad=1, kernel_size=3, stride=stride, **_CONVOLUTION
            )
        else:
            below = net.pool5 = _max_pool(below, 3, 1, pad=1) if dilated else _max_pool(below, 2, 2)
        window: dict[str, int] = {}
        if fully_conv:
            factor = {(True, True): 6, (True, False): 2, (False, True): 3, (False, False): 1}[dilated, reduced]
            kernel, dilation = (3 if reduced else 7), dilation * factor
            window = {"pad": dilation * (kernel - 1) // 2, "kernel_size": kernel, "dilation": dilation}
        _fully_connected(net, below, window, reduced, dropout)
    return _freeze(net, freeze_layers)


def ResNet101Body(
    net: NetSpec, from_layer: str, use_pool5: bool = True, use_dilation_conv5: bool = False, **bn_param: Any
) -> NetSpec:
    """Add ResNet-101 up to res5c, with ``use_pool5`` up to its mean over the map."""
    return _resnet(net, from_layer, 3, 22, use_pool5, use_dilation_conv5, bn_param)


def ResNet152Body(
    net: NetSpec, from_layer: str, use_pool5: bool = True, use_dilation_conv5: bool = False, **bn_param: Any
) -> NetSpec:
    """Add ResNet-152 up to res5c, with ``use_pool5`` up to its mean over the map."""
    return _resnet(net, from_layer, 7, 35, use_pool5, use_dilation_conv5, bn_param)


def _resnet(
    net: NetSpec, from_layer: str, more3: int, more4: int, pool5: bool, dilated: bool, bn_param: dict[str, Any]
) -> NetSpec:
    names: dict[str, Any] = {"bn_prefix": "bn_", "bn_postfix": "", "scale_prefix": "scale_", "scale_postfix": ""}
    window = {"kernel_size": 7, "pad": 3, "stride": 2}
    ConvBNLayer(net, from_layer, "conv1", use_bn=True, use_relu=True, num_output=64, **window, **names, **bn_param)
    net.pool1 = _max_pool(net.conv1, 3, 2)
    stages = (
        (("2a", "2b", "2c"), 64, 1, 1),
        (("3a", *(f"3b{k}" for k in range(1, more3 + 1))), 128, 2, 1),
        (("4a", *(f"4b{k}" for k in range(1, more4 + 1))), 256, 2, 1),
        (("5a", "5b", "5c"), 512, 1 if dilated else 2, 2 if dilated else 1),
    )
    below = "pool1"
    for blocks, width, stride, dilation in stages:
        for block in blocks:
            first = block == blocks[0]
            widths = width, width, 4 * width
            ResBody(net, below, block, *widths, stride if first else 1, first, dilation=dilation, **bn_param)
            below = f"res{block}"
    if pool5:
        net.pool5 = L.Pooling(net.res5c, pool=P.Pooling.AVE, global_pooling=True)
    return net


def InceptionV3Body(net: NetSpec, from_layer: str, output_pred: bool = False, **bn_param: Any) -> NetSpec:
    """Add Inception v3 up to mixed_10/join, with ``output_pred`` up to its 1,008 probabilities."""
    for name, outputs, kernel, pad, stride in (
        *(("conv", 32, 3, 0, 2), ("conv_1", 32, 3, 0, 1), ("conv_2", 64, 3, 1, 1), ("pool", 0, 3, 0, 2)),
        *(("conv_3", 80, 1, 0, 1), ("conv_4", 192, 3, 0, 1), ("pool_1", 0, 3, 0, 2)),
    ):
        window = {"kernel_size": kernel, "pad": pad, "stride": stride}
        if outputs:
            ConvBNLayer(net, from_layer, name, True, True, outputs, **window, use_scale=False, **bn_param)
        else:
            net[name] = L.Pooling(net[from_layer], pool=P.Pooling.MAX, **window)
        from_layer = name

    def tower(source: str, name: str, *layers: Mapping[str, Any]) -> Top:
        return InceptionTower(net, source, name, layers, **bn_param)

    def join(name: str, *towers: Top) -> str:
        net[f"{name}/join"] = L.Concat(*towers, axis=1)
        return f"{name}/join"

    for k in range(3):
        name = f"mixed_{k}" if k else "mixed"
        one = tower(from_layer, name, _step("conv", 64))
        two = tower(from_layer, f"{name}/tower", _step("conv", 48), _step("conv_1", 64, 5))
        three = tower(from_layer, f"{name}/tower_1", _step("conv", 64), _step("conv_1", 96, 3), _step("conv_2", 96, 3))
        four = tower(from_layer, f"{name}/tower_2", _pool(P.Pooling.AVE), _step("conv", 64 if k else 32))
        from_layer = join(name, one, two, three, four)
    name = "mixed_3"
    one = tower(from_layer, name, _step("conv", 384, 3, stride=2))
    halving = _step("conv_2", 96, 3, stride=2)
    two = tower(from_layer, f"{name}/tower", _step("conv", 64), _step("conv_1", 96, 3), halving)
    from_layer = join(name, one, two, tower(from_layer, name, _pool(P.Pooling.MAX, stride=2)))
    for k, width in ((4, 128), (5, 160), (6, 160), (7, 192)):
        name = f"mixed_{k}"
        one = tower(from_layer, name, _step("conv", 192))
        crossed = _step("conv", width), _step("conv_1", width, [1, 7]), _step("conv_2", 192, [7, 1])
        two = tower(from_layer, f"{name}/tower", *crossed)
        twice = _step("conv", width), _step("conv_1", width, [7, 1]), _step("conv_2", width, [1, 7])
        more = _step("conv_3", width, [7, 1]), _step("conv_4", 192, [1, 7])
        three = tower(from_layer, f"{name}/tower_1", *twice, *more)
        four = tower(from_layer, f"{name}/tower_2", _pool(P.Pooling.AVE), _step("conv", 192))
        from_layer = join(name, one, two, three, four)
    name = "mixed_8"
    one = tower(from_layer, f"{name}/tower", _step("conv", 192), _step("conv_1", 320, 3, stride=2))
    crossed = _step("conv", 192), _step("conv_1", 192, [1, 7]), _step("conv_2", 192, [7, 1])
    two = tower(from_layer, f"{name}/tower_1", *crossed, _step("conv_3", 192, 3, stride=2))
    from_layer = join(name, one, two, tower(from_layer, name, _pool(P.Pooling.MAX, stride=2)))
    for k, pool in ((9, P.Pooling.AVE), (10, P.Pooling.MAX)):
        name = f"mixed_{k}"
        towers = [tower(from_layer, name, _step("conv", 320))]
        for suffix, steps in (("", [_step("conv", 384)]), ("_1", [_step("conv", 448), _step("conv_1", 384, 3)])):
            stem = f"{name}/tower{suffix}"
            tower(from_layer, stem, *steps)
            source, mixed = f"{stem}/{steps[-1]['name']}", f"{stem}/mixed"
            sides = [
                tower(source, mixed, _step("conv", 384, [1, 3])),
                tower(source, mixed, _step("conv_1", 384, [3, 1])),
            ]
            net[mixed] = L.Concat(*sides, axis=1)
            towers.append(net[mixed])
        towers.append(tower(from_layer, f"{name}/tower_2", _pool(pool), _step("conv", 192)))
        from_layer = join(name, *towers)
    if output_pred:
        net.pool_3 = L.Pooling(net[from_layer], pool=P.Pooling.AVE, kernel_size=8, pad=0, stride=1)
        net.softmax = L.InnerProduct(net.pool_3, num_output=1008)
        net.softmax_prob = L.Softmax(net.softmax)
    return net


def _step(name: str, outputs: int, kernel: Any = 1, stride: int = 1) -> dict[str, Any]:
    """Return a convolution of a tower: with stride 1 padded to keep the size, with stride 2 not padded."""
    if isinstance(kernel, list):
        return {
            **{"name": name, "num_output": outputs, "kernel_size": kernel},
            **{"pad": [extent // 2 for extent in kernel], "stride": [stride] * 2},
        }
    pad = kernel // 2 if stride == 1 else 0
    return {"name": name, "num_output": outputs, "kernel_size": kernel, "pad": pad, "stride": stride}


def _pool(pool: int, stride: int = 1) -> dict[str, Any]:
    return {"name": "pool", "pool": pool, "kernel_size": 3, "pad": 1 if stride == 1 else 0, "stride": stride}


def _convolution(
    net: NetSpec, name: str, relu: str, below: Top, outputs: int, pad: int, kernel: int, **more: int
) -> Top:
    """Add a convolution and its ReLU; return the top."""
    net[name] = L.Convolution(below, num_output=outputs, pad=pad, kernel_size=kernel, **more, **_CONVOLUTION)
    net[relu] = L.ReLU(net[name], in_place=True)
    return net[relu]


def _max_pool(below: Top, kernel: int, stride: int, **more: int) -> Top:
    return L.Pooling(below, pool=P.Pooling.MAX, kernel_size=kernel, stride=stride, **more)


def _fully_connected(net: NetSpec, below: Top, window: dict[str, int], reduced: bool, dropout: bool) -> None:
    """Add fc6 and fc7: convolutions where there is a window for fc6, else InnerProducts."""
    for number, size in ((6, window), (7, {"kernel_size": 1})):
        if window:
            outputs = 1024 if reduced else 4096
            net[f"fc{number}"] = L.Convolution(below, num_output=outputs, **size, **_CONVOLUTION)
        else:
            net[f"fc{number}"] = L.InnerProduct(below, num_output=4096)
        below = net[f"relu{number}"] = L.ReLU(net[f"fc{number}"], in_place=True)
        if dropout:
            net[f"drop{number}"] = L.Dropout(below, dropout_ratio=0.5, in_place=True)


def _freeze(net: NetSpec, names: Sequence[str]) -> NetSpec:
    """Set the rates of layers to 0, where the net has them."""
    for name in set(names) & set(net.keys()):
        net.update(name, {**_CONVOLUTION, "param": _FROZEN})
    return net


# ---- Heads ----


def CreateMultiBoxHead(
    net: NetSpec,
    data_layer: str = "data",
    num_classes: int = 0,
    from_layers: Sequence[str] = (),
    use_objectness: bool = False,
    normalizations: Sizes = (),
    use_batchnorm: bool = True,
    lr_mult: float = 1,
    use_scale: bool = True,
    min_sizes: Sizes = (),
    max_sizes: Sizes = (),
    prior_variance: Sequence[float] = (0.1,),
    aspect_ratios: Sizes = (),
    steps: Sizes = (),
    img_height: int = 0,
    img_width: int = 0,
    share_location: bool = True,
    flip: bool = True,
    clip: bool = True,
    offset: float = 0.5,
    inter_layer_depth: Sizes = (),
    kernel_size: int = 1,
    pad: int = 0,
    conf_postfix: str = "",
    loc_postfix: str = "",
    **bn_param: Any,
) -> list[Top]:
    """Add SSD's heads to some maps; return mbox_loc, mbox_conf and mbox_priorbox (and mbox_objectness).

    The sequences have one entry for each of ``from_layers``: the value to normalize to (-1 for none), the sizes and
    aspect ratios of the prior boxes, their step, the depth of a convolution in between (0 for none).
    """
    assert num_classes, "must provide num_classes"
    assert num_classes > 0, "num_classes must be positive number"
    for name, given in (
        *(("normalizations", normalizations), ("max_sizes", max_sizes), ("aspect_ratios", aspect_ratios)),
        *(("steps", steps), ("inter_layer_depth", inter_layer_depth)),
    ):
        assert not given or len(given) == len(from_layers), f"from_layers and {name} should have same length"
    assert len(from_layers) == len(min_sizes), "from_layers and min_sizes should have same length"
    assert data_layer in net.keys(), "data_layer is not in net's layers"  # noqa: SIM118 (a NetSpec is no dict)

    def predict(source: str, name: str, outputs: int) -> Top:
        window = {"kernel_size": kernel_size, "pad": pad, "stride": 1, "lr_mult": lr_mult}
        ConvBNLayer(net, source, name, use_batchnorm, False, outputs, **window, **bn_param)
        net[f"{name}_perm"] = L.Permute(net[name], order=[0, 2, 3, 1])
        net[f"{name}_flat"] = L.Flatten(net[f"{name}_perm"], axis=1)
        return net[f"{name}_flat"]

    found: dict[str, list[Top]] = {"loc": [], "conf": [], "priorbox": [], "objectness": []}
    for i, source in enumerate(from_layers):
        if normalizations and normalizations[i] != -1:
            filler = {"type": "constant", "value": normalizations[i]}
            norm = f"{source}_norm"
            net[norm] = L.Normalize(net[source], scale_filler=filler, across_spatial=False, channel_shared=False)
            source = norm
        if inter_layer_depth and inter_layer_depth[i] > 0:
            inter = f"{source}_inter"
            window: dict[str, Any] = {"kernel_size": 3, "pad": 1, "stride": 1, "lr_mult": lr_mult}
            ConvBNLayer(net, source, inter, use_batchnorm, True, inter_layer_depth[i], **window, **bn_param)
            source = inter
        least, most, ratios = (_listed(values, i) for values in (min_sizes, max_sizes, aspect_ratios))
        assert not most or len(most) == len(least), "max_size and min_size should have same length."
        priors = len(least) * (1 + bool(most) + len(ratios) * (2 if flip else 1))
        places = priors * 4 * (1 if share_location else num_classes)
        found["loc"].append(predict(source, f"{source}_mbox_loc{loc_postfix}", places))
        found["conf"].append(predict(source, f"{source}_mbox_conf{conf_postfix}", priors * num_classes))
        boxes: dict[str, Any] = {"min_size": least, "clip": clip, "variance": prior_variance, "offset": offset}
        if most:
            boxes["max_size"] = most
        if ratios:
            boxes |= {"aspect_ratio": ratios, "flip": flip}
        if len(steps) > i and steps[i]:
            boxes["step"] = steps[i]
        if img_height and img_width:
            square = {"img_size": img_height}
            boxes |= square if img_height == img_width else {"img_h": img_height, "img_w": img_width}
        net[f"{source}_mbox_priorbox"] = L.PriorBox(net[source], net[data_layer], **boxes)
        found["priorbox"].append(net[f"{source}_mbox_priorbox"])
        if use_objectness:
            found["objectness"].append(predict(source, f"{source}_mbox_objectness", priors * 2))
    for kind, tops in found.items():
        if tops:
            net[f"mbox_{kind}"] = L.Concat(*tops, axis=2 if kind == "priorbox" else 1)
    return [net[f"mbox_{kind}"] for kind, tops in found.items() if tops]


def _listed(values: Sizes, i: int) -> list[Any]:
    """Return entry i as a list, empty where there is none."""
    if len(values) <= i:
        return []
    return values[i] if isinstance(values[i], list) else [values[i]]

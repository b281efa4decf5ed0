"""The rules for nets. Their docstrings give the reasons; ``netspec lint --rules`` prints them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from netspec.errors import Where
from netspec.graph.plan import Plan
from netspec.inspect.check.findings import NET, PLAN, TEXT, Findings, rule
from netspec.layers import layer_class
from netspec.net.net import Net
from netspec.proto.schema import TEST, TRAIN, NetParameter, fields_of, given
from netspec.proto.source_map import SourceMap

WITHOUT_GRADIENT = frozenset({"Accuracy", "ArgMax", "Threshold"})
OLD_ACCESSORS = 4  # axes: with more, num(), channels(), height() and width() of Caffe's blobs fail
AXES = {  # the numbers of axes that Caffe allows for the bottoms of a layer, if netspec allows others
    "BatchReindex": (1, 32),
    "ContrastiveLoss": (1, OLD_ACCESSORS),
    "EuclideanLoss": (1, OLD_ACCESSORS),
    "HingeLoss": (1, OLD_ACCESSORS),
    "MultinomialLogisticLoss": (1, OLD_ACCESSORS),
    "PReLU": (2, OLD_ACCESSORS),
    "SigmoidCrossEntropyLoss": (1, 32),
}
STOCHASTIC = 2  # caffe.proto: PoolingParameter.PoolMethod
BEFORE_NET = ("mean_value", "mean_file", "scale")  # fields of transform_param that change all images in the same way


@rule("transform-differs", TEXT)
def _transforms(net: NetParameter, source: SourceMap) -> Findings:
    """A net should be tested with the preprocessing it is trained with.

    The layers that make a blob in the two phases should subtract the same mean and multiply by the same scale.
    """
    first: dict[str, int] = {}
    for i, layer in enumerate(net.layer):
        if layer.bottom or not layer.top or not layer.HasField("transform_param"):
            continue
        other = first.setdefault(layer.top[0], i)
        for name in BEFORE_NET:
            here, there = (_plain(getattr(net.layer[k].transform_param, name)) for k in (i, other))
            if here != there:
                line = source.layers[other].where.line
                yield (
                    source.at(i, "transform_param", name, layer=layer.name, type=layer.type),
                    f'{name} is {_as_text(here)} here, and {_as_text(there)} in line {line}, where "{layer.top[0]}" of '
                    "the other phase is read; use the same value in both",
                )


@rule("unused-blob", PLAN)
def _unused(net: NetParameter, source: SourceMap, plan: Plan) -> Findings:
    """In a net with a loss, an unused blob costs time, and a layer that should read it may be missing.

    Losses and scores are printed, so they count as used. Use ``Silence`` for unwanted blobs.
    """
    if not any(map(any, _loss_weights(plan))):
        return  # a deploy net, whose outputs are its purpose
    weights = _loss_weights(plan)
    for i, node in enumerate(plan.nodes):
        cls = layer_class(node.type)
        if cls is None or cls.label_bottoms or cls.is_loss:
            continue
        for j, v in enumerate(node.tops):
            name = plan.blobs[v]
            if plan.outputs.get(name) == v and not any(weights[i][j : j + 1]):
                yield _where(plan, i), f'no layer uses blob "{name}"; remove it, or add a Silence layer'


@rule("loss-without-weight", PLAN)
def _weightless(net: NetParameter, source: SourceMap, plan: Plan) -> Findings:
    """A loss with weight 0 is computed and printed, but has no effect on the training."""
    for i, weights in enumerate(_loss_weights(plan) if _is_training(plan) else ()):
        cls = layer_class(plan.nodes[i].type)
        if cls is not None and cls.is_loss and not any(weights):
            yield _where(plan, i, "loss_weight"), "a loss of weight 0 trains nothing; set another loss_weight"


@rule("batchnorm-without-scale", PLAN)
def _bare_batch_norms(net: NetParameter, source: SourceMap, plan: Plan) -> Findings:
    """Caffe's BatchNorm only normalizes, while in other frameworks it also scales and shifts."""
    readers: dict[int, set[str]] = {}
    for node in plan.nodes:
        for v in node.bottoms:
            readers.setdefault(v, set()).add(node.type)
    for i, node in enumerate(plan.nodes):
        if node.type != "BatchNorm" or not node.tops or "Scale" in readers.get(node.tops[0], set()):
            continue
        fields = plan.net.layer[i].batch_norm_param.ListFields()
        if not any(field.is_extension for field, _ in fields):  # with a fork's, it may scale and shift itself
            yield _where(plan, i), "no Scale layer follows; Caffe's BatchNorm itself does not scale and shift"


@rule("bias-before-batchnorm", PLAN)
def _lost_biases(net: NetParameter, source: SourceMap, plan: Plan) -> Findings:
    """BatchNorm subtracts the mean, including any bias that was added before, so such a bias has no effect."""
    makers = {v: i for i, node in enumerate(plan.nodes) for v in node.tops}
    for node in plan.nodes if _is_training(plan) else ():
        i = makers.get(node.bottoms[0], -1) if node.type == "BatchNorm" and node.bottoms else -1
        for name, param in own_settings(plan.net.layer[i]) if i >= 0 else ():
            fields = fields_of(param.DESCRIPTOR)
            if "weight_filler" in fields and "bias_term" in fields and param.bias_term:
                message = f'its bias is subtracted again by BatchNorm "{node.name}"; set bias_term: false'
                yield _where(plan, i, name), message


@rule("global-stats-in-training", PLAN)
def _global_statistics(net: NetParameter, source: SourceMap, plan: Plan) -> Findings:
    """With use_global_stats: true, a training neither uses the statistics of its batches nor updates the stored ones.

    A net that is trained from scratch then has no normalization. For fine-tuning with fixed statistics, it is correct.
    """
    for i, node in enumerate(plan.nodes if _is_training(plan) else ()):
        if node.type == "BatchNorm" and plan.net.layer[i].batch_norm_param.use_global_stats:
            where = _where(plan, i, "batch_norm_param", "use_global_stats")
            yield where, "use_global_stats is true in phase TRAIN; remove it, so that each phase uses its default"


@rule("batch-stats-in-test", PLAN)
def _batch_statistics(net: NetParameter, source: SourceMap, plan: Plan) -> Findings:
    """With use_global_stats: false, the result of a test depends on which images are in the same batch."""
    for i, node in enumerate(plan.nodes if plan.net.state.phase == TEST else ()):
        param = plan.net.layer[i].batch_norm_param
        if node.type == "BatchNorm" and param.HasField("use_global_stats") and not param.use_global_stats:
            where = _where(plan, i, "batch_norm_param", "use_global_stats")
            yield where, "use_global_stats is false in phase TEST; remove it, so that each phase uses its default"


@rule("zero-weights", PLAN)
def _zero_weights(net: NetParameter, source: SourceMap, plan: Plan) -> Findings:
    """Without a weight_filler, all initial weights are 0 and propagate no gradient.

    A training that starts from trained weights needs no filler.
    """
    for i, node in enumerate(plan.nodes if _is_training(plan) else ()):
        if node.params and (node.params[0].owner or not node.params[0].lr_mult):
            continue
        for name, param in own_settings(plan.net.layer[i]):
            fields = fields_of(param.DESCRIPTOR)
            if "weight_filler" in fields and not fields["weight_filler"].present(param):
                yield (
                    _where(plan, i, name),
                    'its initial weights are all 0; add weight_filler { type: "xavier" } or another',
                )


@rule("softmax-twice", PLAN)
def _softmax_twice(net: NetParameter, source: SourceMap, plan: Plan) -> Findings:
    """SoftmaxWithLoss computes a softmax of its bottom, so a Softmax layer before it makes the gradient too small."""
    makers = {v: i for i, node in enumerate(plan.nodes) for v in node.tops}
    for i, node in enumerate(plan.nodes):
        maker = makers.get(node.bottoms[0], -1) if node.type == "SoftmaxWithLoss" and node.bottoms else -1
        if maker >= 0 and plan.nodes[maker].type == "Softmax":
            name = plan.nodes[maker].name
            yield (
                _where(plan, i),
                f'its bottom is Softmax "{name}", but it computes a softmax itself; use the bottom of "{name}"',
            )


@rule("towers-not-shared", NET)
def _towers(net: Net) -> Findings:
    """The branches that a ContrastiveLoss compares should share all their parameters."""
    producer = {v: i for i, node in enumerate(net.plan.nodes) for v in node.tops}

    def upstream(v: int) -> set[int]:
        found: set[int] = set()
        pending = [v]
        while pending:
            i = producer[pending.pop()]
            if i not in found:
                found.add(i)
                pending.extend(net.plan.nodes[i].bottoms)
        return found

    for node in net.plan.nodes:
        if node.type != "ContrastiveLoss":
            continue
        first, second = (upstream(v) for v in node.bottoms[:2])
        shared = {id(blob) for i in first for blob in net.layers[i].blobs}
        for i in sorted(second - first):
            count = sum(id(blob) not in shared for blob in net.layers[i].blobs)
            if count:
                total = len(net.layers[i].blobs)
                yield (
                    _where(net.plan, i),
                    f"{count} of its {total} parameter blobs are not shared with the other branch of "
                    f'"{node.name}"; give them the same param {{ name }}',
                )


@rule("loss-learns-nothing", NET)
def _losses(net: Net) -> Findings:
    """A loss that depends on no learnable parameter has no effect on the training."""
    for i, weights in enumerate(net.loss_weights if net.phase == TRAIN else ()):
        if any(weights) and not net.backward_plan.layers[i]:
            yield (_where(net.plan, i), "this loss depends on no learnable parameter; is lr_mult 0?")


@rule("caffe-stops", NET)
def _caffe_stops(net: Net) -> Findings:
    """Caffe ends the program if a blob has more axes than a layer supports, or if a gradient is needed that
    a layer does not compute.

    netspec runs such a net, without that gradient.
    """
    for i, (node, layer) in enumerate(zip(net.plan.nodes, net.layers, strict=True)):
        for j, shape in enumerate(layer.bottom_shapes):
            fewest, most = AXES.get(node.type, (0, 32))
            if not fewest <= len(shape) <= most:
                message = f"Caffe stops here: {node.type} takes {fewest} to {most} axes, bottom {j} has {len(shape)}"
                yield _where(net.plan, i, "bottom", j), f"{message}; put a Reshape before it"
        if node.type == "Pooling" and net.plan.net.layer[i].pooling_param.pool == STOCHASTIC:
            message = "Caffe stops here without a GPU: it has STOCHASTIC pooling only for CUDA; set another pool"
            yield _where(net.plan, i, "pooling_param", "pool"), message
        asked = net.backward_plan.bottoms[i] if net.phase == TRAIN and net.backward_plan.layers[i] else ()
        for j, wanted in enumerate(asked):
            if wanted and (node.type in WITHOUT_GRADIENT or j in layer.label_bottoms):
                message = f"Caffe stops in the backward pass: {node.type} has no gradient for bottom {j}"
                yield _where(net.plan, i, "bottom", j), f"{message}; set propagate_down: false"


@rule("never-learns", NET)
def _never_learns(net: Net) -> Findings:
    """If no loss depends on a layer, its weights never change, although it has a learning rate."""
    if net.phase != TRAIN or not any(map(any, net.loss_weights)):
        return
    learned = {item.layer for item in net.learnable if item.lr_mult}
    for i, node in enumerate(net.plan.nodes):
        if node.name in learned and not net.backward_plan.layers[i] and net.layers[i].blob_shapes:
            yield _where(net.plan, i), "no loss depends on it, so it learns nothing; set lr_mult: 0, or use its blob"


@rule("same-name", NET)
def _namesakes(net: Net) -> Findings:
    """Saved weights are assigned to layers by name."""
    names: set[str] = set()
    for i, (node, layer) in enumerate(zip(net.plan.nodes, net.layers, strict=True)):
        if node.name in names and layer.blob_shapes:
            yield (
                _where(net.plan, i),
                "an earlier layer has the same name; loaded weights go to that layer only; rename one",
            )
        names.add(node.name)


def _loss_weights(plan: Plan) -> list[list[float]]:
    """Return the loss weights of each layer's tops, as far as types are known."""
    weights = []
    for node, layer in zip(plan.nodes, plan.net.layer, strict=True):
        cls = layer_class(node.type)
        usual = [1.0] if cls is not None and cls.is_loss else []
        weights.append(list(layer.loss_weight) or usual)
    return weights


def _is_training(plan: Plan) -> bool:
    """Return whether the net trains: it is in phase TRAIN and has a loss."""
    classes = (layer_class(node.type) for node in plan.nodes)
    has_loss = any(cls is not None and cls.is_loss for cls in classes) or any(map(any, _loss_weights(plan)))
    return plan.net.state.phase == TRAIN and has_loss


def own_settings(layer: Any) -> Iterator[tuple[str, Any]]:
    """Yield the names and messages of the fields with a layer's own settings."""
    for field in given(layer):
        if field.name.endswith("_param") and not field.repeated:
            yield field.name, field.get(layer)


def _where(plan: Plan, i: int, *path: str | int) -> Where:
    return plan.source.at(i, *path, layer=plan.nodes[i].name, type=plan.nodes[i].type)


def _plain(value: Any) -> Any:
    return value if isinstance(value, (str, float, int)) else tuple(value)


def _as_text(value: Any) -> str:
    values = value if isinstance(value, tuple) else (value,)
    return " ".join(f"{each:g}" if isinstance(each, float) else str(each) for each in values) or "absent"

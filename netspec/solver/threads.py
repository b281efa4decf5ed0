"""Whether the number of threads changes the bits of a training."""

from __future__ import annotations

from netspec.exact import ALL, NONE
from netspec.net.net import Net


def divided_sums(net: Net) -> list[str]:
    """Return the layers on the CPU whose sums torch divides among its threads: those not computed in Caffe's order."""
    if net.options.exact == ALL or net.device.type != "cpu":
        return []
    return [
        node.name
        for node, layer in zip(net.plan.nodes, net.layers, strict=True)
        if layer.small is not None and (net.options.exact == NONE or not layer.small)
    ]


def dependence(net: Net, threads: int) -> str:
    """Return what to say of a net whose bits depend on the number of threads; "" if they do not."""
    layers = divided_sums(net) if threads > 1 else []
    if not layers:
        return ""
    others = f" and {len(layers) - 1} more" if len(layers) > 1 else ""
    return (
        f"{threads} threads share the sums of {layers[0]}{others}: another number of threads changes the last bits of "
        "the weights. To prevent it, set --exact all (slower), or OMP_NUM_THREADS=1"
    )

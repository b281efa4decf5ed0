"""Writes small/ and normalized/ beside this file: the paper's nets with a few changes.

normalized  descriptors of length 1, which the paper does not name: they train whatever the seed
small       the same for pairs of 64x64 pixels and a laptop: batches of 32, 300 iterations
normalized/siamese_slim27_128  a quarter of the channels

Needs nothing but Python. tools/install.py and the build of the wheel run it.
"""

import re
from pathlib import Path

HERE = Path(__file__).parent
NETS = ("siamese_8", "siamese_128", "siamese_resnet27_256", "siamese_resnet27_512")
LENGTH_1 = """layer {
  name: "feat_sumsq~"
  type: "Reduction"
  bottom: "ip_feat~"
  top: "feat_sumsq~"
  reduction_param { operation: SUMSQ axis: 1 }
}
layer {
  name: "feat_inverse~"
  type: "Power"
  bottom: "feat_sumsq~"
  top: "feat_inverse~"
  power_param { power: -0.5 shift: 1e-8 }
}
layer {
  name: "feat~"
  type: "Scale"
  bottom: "ip_feat~"
  bottom: "feat_inverse~"
  top: "feat~"
  scale_param { axis: 0 }
}
"""
NORMALIZED = (
    "# With descriptors of length 1 (the last three layers of a tower), which the paper does not name: it trains"
)
SLIM = """\
# Siamese + 27-layer ResNet with a quarter of the channels, 128 neurons, and descriptors of length 1, so that the margin
# has a scale: pairs of 64x64 color images. See docs/trained.md.
"""
BATCHES = {"batch_size: 256": "batch_size: 32", "batch_size: 250": "batch_size: 50"}
SOLVER = {
    "test_iter: 24  # 24 x 250 = the 6000": "test_iter: 8  # 8 x 50",
    "test_interval: 500": "test_interval: 50",
    "stepsize: 10000": "stepsize: 100",
    "max_iter: 30000": "max_iter: 300",
    "display: 100\naverage_loss: 100\nsnapshot: 2500": "display: 10\naverage_loss: 10\nsnapshot: 50",
    "solver_mode: GPU": "solver_mode: CPU",
}
SLIM_SOLVER = {
    "test_iter: 24  # 24 x 250 = the 6000": "test_iter: 28  # 28 x 50",
    "  # before the first update BatchNorm has no statistics to test with": "",
    "base_lr: 0.01": "base_lr: 0.03",
    'lr_policy: "step"': 'lr_policy: "multistep"',
    "stepsize: 10000": "stepvalue: 6000\nstepvalue: 7500",
    "max_iter: 30000\nmomentum: 0.9\nweight_decay: 0.0005\n": "max_iter: 8000\n",
    "display: 100\naverage_loss: 100\nsnapshot: 2500\n": (
        "display: 50\naverage_loss: 50\nsnapshot: 500\nmomentum: 0.9\nweight_decay: 0.0005\n"
    ),
}


def replaced(text: str, changes: dict[str, str]) -> str:
    """Return a text with changes, each of which must find its place."""
    for old, new in changes.items():
        assert old in text, f"no {old!r}"
        text = text.replace(old, new)
    return text


def normalized(text: str) -> str:
    """Return a net whose towers end in descriptors of length 1."""
    text = re.sub(r"# As the paper draws it.*", f"{NORMALIZED} whatever the seed.", text)
    for tower in ("", "_p"):
        last = re.compile(rf'layer {{\n  name: "feat{tower}"\n  type: "InnerProduct"\n.*?\n}}\n', re.DOTALL)
        text = last.sub(lambda found, t=tower: found[0].replace('"feat', '"ip_feat') + LENGTH_1.replace("~", t), text)
    return text


def at_64(text: str, pairs: str) -> str:
    """Return a net for images of 64x64 pixels, in small batches."""
    text = re.sub(r'"data/pairs_(\w+)"', rf'"data/{pairs}64_\1"', text).replace("224x224", "64x64")
    text = text.replace("dim: 224 dim: 224", "dim: 64 dim: 64")
    return replaced(text, BATCHES) if "batch_size" in text else text


def small(text: str) -> str:
    """Return a small net; without the paper's statistics and comments, which hold at its size only."""
    text = re.sub(
        r"(images)\.\n# The paper's Table I.*\n#.*\n",
        r"\1. For a laptop; see prototxt/README.md.\n",
        at_64(text, "pairs"),
    )
    text = re.sub(r'^(name: "\w+?)(_deploy)?"', r'\1_small\2"', text, count=1, flags=re.MULTILINE)
    return text.replace("fraction: 0.999", "fraction: 0.9")


def slim(text: str) -> str:
    """Return a net with a quarter of the channels."""
    text = re.sub(r"\A(#.*\n)+(?=name: \"\w+256\"$)", SLIM, at_64(text, "mix"), flags=re.MULTILINE)
    text = re.sub(r"(convolution_param { num_output: )(\d+)", lambda found: f"{found[1]}{int(found[2]) // 4}", text)
    text = text.replace("fraction: 0.999", "fraction: 0.99").replace("siamese_resnet27_256", "siamese_slim27_128")
    return text.replace("inner_product_param { num_output: 256", "inner_product_param { num_output: 128")


def write(folder: str, net: str, source: str) -> None:
    """Write a variant, ``folder/net``, of the paper's net ``source``."""
    target = HERE / folder / net
    target.mkdir(parents=True, exist_ok=True)
    for file in ("train_val", "deploy", "solver"):
        text = (HERE / source / f"{file}.prototxt").read_text("utf-8")
        if file == "solver":
            text = text.replace(f"prototxt/{source}/", f"prototxt/{folder}/{net}/").replace(f'/{source}"', f'/{net}"')
            changes = {"small": SOLVER, "siamese_slim27_128": SLIM_SOLVER}
            text = replaced(text, changes.get(folder, changes.get(net, {})))
        else:
            text = normalized(text)
            text = small(text) if folder == "small" else slim(text) if net == "siamese_slim27_128" else text
        (target / f"{file}.prototxt").write_text(text, "utf-8")


def main() -> None:
    """Write all of them."""
    for net in NETS:
        write("normalized", net, net)
        write("small", net, net)
    write("normalized", "siamese_slim27_128", "siamese_resnet27_256")


if __name__ == "__main__":
    main()

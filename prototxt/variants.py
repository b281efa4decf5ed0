"""Writes small/ and normalized/ beside this file: the paper's nets with a few changes.

normalized  descriptors of length 1, which the paper does not name: they train whatever the seed
small       the same for pairs of 64x64 pixels and a laptop: batches of 32, 300 iterations

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
BATCHES = {"batch_size: 256": "batch_size: 32", "batch_size: 250": "batch_size: 50"}
SOLVER = {
    "test_iter: 24  # 24 x 250 = the 6000": "test_iter: 8  # 8 x 50",
    "test_interval: 500": "test_interval: 50",
    "stepsize: 10000": "stepsize: 100",
    "max_iter: 30000": "max_iter: 300",
    "display: 100\naverage_loss: 100\nsnapshot: 2500": "display: 10\naverage_loss: 10\nsnapshot: 50",
    "solver_mode: GPU": "solver_mode: CPU",
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


def small(text: str) -> str:
    """Return a net for images of 64x64 pixels, without the paper's comments, which hold at its size only."""
    text = re.sub(r'"data/pairs_(\w+)"', r'"data/pairs64_\1"', text).replace("224x224", "64x64")
    text = text.replace("dim: 224 dim: 224", "dim: 64 dim: 64")
    text = replaced(text, BATCHES) if "batch_size" in text else text
    text = re.sub(r"(images)\.\n# The paper's Table I.*\n#.*\n", r"\1. For a laptop; see prototxt/README.md.\n", text)
    text = re.sub(r'^(name: "\w+?)(_deploy)?"', r'\1_small\2"', text, count=1, flags=re.MULTILINE)
    return text.replace("fraction: 0.999", "fraction: 0.9")


def write(folder: str, net: str) -> None:
    """Write the variant ``folder/net`` of a net of the paper."""
    target = HERE / folder / net
    target.mkdir(parents=True, exist_ok=True)
    for file in ("train_val", "deploy", "solver"):
        text = (HERE / net / f"{file}.prototxt").read_text("utf-8")
        if file == "solver":
            text = text.replace(f"prototxt/{net}/", f"prototxt/{folder}/{net}/")
            text = replaced(text, SOLVER if folder == "small" else {})
        else:
            text = small(normalized(text)) if folder == "small" else normalized(text)
        (target / f"{file}.prototxt").write_text(text, "utf-8")


def main() -> None:
    """Write all of them."""
    for net in NETS:
        write("normalized", net)
        write("small", net)


if __name__ == "__main__":
    main()

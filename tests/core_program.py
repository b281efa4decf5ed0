"""Print a hash of the results of each net: ``python core_program.py COUNT``, for laws/test_optional_packages.py.

The nets are golden cases of layers, forward and backward; golden trainings; and COUNT random nets, in phase TEST and in
training, and with pycaffe if it is there. Nothing else that it imports needs an optional package.
"""

import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

import netspec
from drawn_nets import drawn
from golden_cases import LayerCase, assert_arrays, assert_same_layers, parameters, train
from netspec.exact import CHOICES
from netspec.log import silent
from paths import GOLDEN

TOLERANCE = 1e-4  # of the largest element, of what Caffe computed
TRAININGS = ("sgd_step", "adam", "residual_bn_private")
ITERATIONS = 5


def hash_of(arrays: Iterable[np.ndarray]) -> str:
    found = hashlib.sha256()
    for array in arrays:
        found.update(f"{array.shape} {array.dtype}".encode())
        if array.dtype.kind == "f":  # NaN, and zero, as of a gradient that vanishes, have one form each
            array = np.where(np.isnan(array), np.nan, array).astype(array.dtype) + 0.0
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def golden(folder: Path) -> str:
    case = LayerCase(folder)
    found = case.compute("small")
    assert_arrays(found, case.golden, TOLERANCE, folder.name)
    return hash_of(found[name] for name in sorted(found))


def training(name: str, exact: str) -> str:
    solver = netspec.load_solver(f"{name}/solver.prototxt", f"{name}/init.caffemodel", device="cpu", exact=exact)
    losses = train(solver, ITERATIONS)
    solver.close()
    golden = np.load(f"{name}/after_{ITERATIONS}.npz")
    found = parameters(solver.net, golden, "")
    assert_same_layers(found, golden, TOLERANCE)
    return hash_of([np.array(losses), *found.values()])


def trained(prototxt: str, exact: str) -> str:
    net = netspec.load_net(prototxt, phase="TRAIN", seed=1, exact=exact)
    for _ in range(2):
        net.zero_grad()
        found = net.forward_backward()
        if found is None:
            found = net.forward_loss()
            found[0].backward()
    learned = [item.parameter for item in net.learnable]
    gradients = [torch.zeros_like(blob) if blob.grad is None else blob.grad for blob in learned]
    return hash_of(x.detach().numpy() for x in (found[0], *gradients, *learned))


def forward(prototxt: str, exact: str) -> str:
    net = netspec.load_net(prototxt, phase="TEST", seed=1, exact=exact)
    with torch.no_grad():
        return hash_of(blob.numpy() for blob in (*net().values(), *net().values()))


def by_pycaffe(prototxt: str) -> str:
    import netspec.pycaffe as caffe

    caffe.set_random_seed(1)
    net = caffe.Net(prototxt, caffe.TRAIN)
    for _ in range(2):
        net.clear_param_diffs()
        net.forward()
        net.backward()
    blobs = [*net.blobs.values(), *(blob for layer in net.params.values() for blob in layer)]
    return hash_of(array for blob in blobs for array in (blob.data, blob.diff))


def numbers(count: int) -> dict[str, str]:
    """Return the hashes by name; the working directory is one with the goldens' databases."""
    found: dict[str, str] = {}

    def note(name: str, compute: Callable[..., str], *arguments: object) -> None:
        try:
            found[name] = compute(*arguments)
        except netspec.SpecError as fault:  # of a random net: a filter larger than its map
            found[name] = str(fault)

    for folder in sorted((GOLDEN / "layers").iterdir()):
        note(folder.name, golden, folder)
    for name in TRAININGS:
        for exact in CHOICES:
            note(f"{name} {exact}", training, name, exact)
    for seed in range(count):
        Path("random.prototxt").write_text(drawn(seed))
        for exact in CHOICES:
            note(f"random {seed} {exact}", trained, "random.prototxt", exact)
        note(f"random {seed} forward", forward, "random.prototxt", "all")
        if find_spec("netspec.compat"):
            note(f"random {seed} pycaffe", by_pycaffe, "random.prototxt")
    return found


if __name__ == "__main__":
    torch.set_num_threads(1)
    with TemporaryDirectory() as folder, silent():
        for path in (GOLDEN / "pairs", *(GOLDEN / "train" / name for name in TRAININGS)):
            (Path(folder) / path.name).symlink_to(path)
        os.chdir(folder)
        hashes = numbers(int(sys.argv[1]))
    print(json.dumps(hashes))

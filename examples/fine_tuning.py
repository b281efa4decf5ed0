"""Fine-tuning: layers with the same name start from trained weights, and a renamed layer learns other classes."""

import os
import sys
import tempfile
from pathlib import Path

import numpy as np
from sklearn.datasets import load_digits

import netspec.pycaffe as caffe
from netspec.pycaffe import layers as L


def write(name, score):
    """Write a net and its solver; ``score`` is the name of its last layer."""
    n = caffe.NetSpec()
    n.data, n.label = L.Input(shape={"dim": [50, 64]}), L.Input(shape={"dim": [50]})
    slow = [{"lr_mult": 0.1}, {"lr_mult": 0.2}] if name == "tuned" else [{"lr_mult": 1}, {"lr_mult": 2}]
    n.fc1 = L.InnerProduct(n.data, num_output=50, weight_filler={"type": "xavier"}, param=slow)
    n.relu1 = L.ReLU(n.fc1, in_place=True)
    n[score] = L.InnerProduct(n.relu1, num_output=5, weight_filler={"type": "xavier"})
    n.loss = L.SoftmaxWithLoss(n[score], n.label)
    n.accuracy = L.Accuracy(n[score], n.label)
    Path(f"{name}.prototxt").write_text(str(n.to_proto()))
    Path(f"{name}_solver.prototxt").write_text(
        f'net: "{name}.prototxt" base_lr: 0.1 momentum: 0.9 lr_policy: "fixed" random_seed: 3\n'
    )


def train(solver, images, labels, iterations):
    """Train on random batches; return the accuracy on the last 10 batches."""
    random, scores = np.random.RandomState(1), []
    for _ in range(iterations):
        chosen = random.randint(len(images), size=50)
        solver.net.blobs["data"].data[...] = images[chosen]
        solver.net.blobs["label"].data[...] = labels[chosen]
        solver.step(1)
        scores.append(float(solver.net.blobs["accuracy"].data))
    return np.mean(scores[-10:])


os.chdir(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
digits = load_digits()
low = digits.target < 5
write("first", "score_low")
write("tuned", "score_high")
first = caffe.SGDSolver("first_solver.prototxt")
print(f"0 to 4, from scratch: {train(first, digits.data[low] / 16, digits.target[low], 200):.2f}")
first.net.save("first.caffemodel")
for title, weights in (("from scratch", None), ("fine-tuned", "first.caffemodel")):
    solver = caffe.SGDSolver("tuned_solver.prototxt")
    if weights:
        solver.net.copy_from(weights)  # fc1; score_high is not in it
    print(f"5 to 9, {title}, 20 iterations: {train(solver, digits.data[~low] / 16, digits.target[~low] - 5, 20):.2f}")

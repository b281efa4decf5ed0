"""Train the net places: words on a fixed trunk, with many negatives, combined with the words of siamese_words_256.

python trained_head.py FOLDER ITERATIONS LIST...: FOLDER has the files of efficientnet_lite0.py, a LIST batches of 64
pairs of views of 192x144 (docs/trained.md). It writes places.prototxt and places.caffemodel. Loss: Sohn, NIPS 2016.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
import torch
from torch.nn import functional

import netspec
import netspec.pycaffe as caffe
from lmdb_build import read_pair_list
from netspec.inspect.features.describer import Describer
from netspec.proto.text import read_net, write_text

RATE, WARM, SCALE, VIEWS = 2e-3, 30, 20, 128  # learning rate, iterations until it is reached, and views per batch
LATE = 0.87  # after this share of the training, each pair also competes with all other pairs of its batch
folder, iterations, lists = Path(sys.argv[1]), int(sys.argv[2]), [Path(name) for name in sys.argv[3:]]
example = Path(__file__).with_suffix(".prototxt")
many = Path(__file__).parents[2] / "prototxt" / "many_negatives" / "siamese_words_256"
source, prototxt = folder / "efficientnet_lite0.caffemodel", folder / "places.prototxt"
net, layers, words = (read_net(p) for p in (source.with_suffix(".prototxt"), example, many / "deploy.prototxt"))
del net.layer[[layer.name for layer in net.layer].index("block10") + 1 :]
net.layer[0].input_param.shape[0].dim[:], net.name = [1, 3, 144, 192], "places"
words.layer[1].bottom[0] = "small"
words.layer[-1].name = words.layer[-1].top[0] = "words_feat"
words.layer[-1].power_param.scale *= 1.49**-0.5
net.layer.extend([*layers.layer[1:-2], *words.layer[1:], *layers.layer[-2:]])
prototxt.write_text(write_text(net).replace("  include {\n    phase: TEST\n  }\n", ""))
trunk, maps = Describer(prototxt, source, "head_blocks").image_net, []
for views in lists:
    if not views.with_suffix(".npy").exists():
        files = [views.parent / name for pair in read_pair_list(views) for name in (pair.first, pair.second)]
        batches = ([cv2.imread(str(file)) for file in files[k : k + VIEWS]] for k in range(0, len(files), VIEWS))
        np.save(views.with_suffix(".npy"), np.concatenate([trunk(batch).astype(np.float16) for batch in batches]))
    maps.extend(np.load(views.with_suffix(".npy"), mmap_mode="r").reshape(-1, VIEWS, 192, 9, 12))
head, rng = netspec.load_net(example, "TRAIN", seed=1), np.random.default_rng(1)
optimizer = torch.optim.AdamW(head.parameters())
itself, partner = 1e4 * torch.eye(VIEWS), torch.arange(VIEWS) ^ 1  # views 0 and 1 are a pair, 2 and 3, ...
others = (itself == 0).index_put((torch.arange(VIEWS), partner), torch.tensor(False))
for k in range(iterations):
    x = torch.from_numpy(maps[rng.integers(len(maps))].astype(np.float32))
    units = head(head_blocks=x.flip(3) if rng.random() < 0.5 else x)["head_feat"].split([512, 768], 1)
    whole, parts = (2 * SCALE * u @ u.T for u in units)
    loss = torch.stack([functional.cross_entropy(c - itself, partner) for c in (whole, parts)]).sum()
    for c in (whole, parts, (whole + parts) / 2) if k >= LATE * iterations else ():
        loss = loss + functional.softplus(c[others].logsumexp(0) - c[torch.arange(VIEWS), partner]).mean() / 1.5
    turn = np.pi * min(1, k / iterations / LATE)
    optimizer.param_groups[0]["lr"] = RATE * min(1, (k + 1) / WARM) * (0.55 + 0.45 * np.cos(turn))
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
netspec.save_weights(head, folder / "head.caffemodel")
places = caffe.Net(str(prototxt), caffe.TEST)
for weights in (source, folder / "head.caffemodel", many / "siamese_words_256.caffemodel"):
    places.copy_from(str(weights))
lines = cv2.resize(np.eye(6), (6, 5))
for layer, square in (("resized", np.kron(lines, lines)), ("small", np.eye(25))):
    places.params[layer][0].data.reshape(3, *square.shape)[...] = square
places.save(str(folder / "places.caffemodel"))
print(f"{folder}/places.caffemodel: {len(maps)} batches, loss {loss:.3f}")

"""Continue the training of the words of siamese_words_256 in the net places: by distillation, with many negatives.

python distilled_words.py FOLDER ITERATIONS WEIGHTS LIST...: FOLDER has the files of trained_head.py, WEIGHTS are
siamese_words_256.caffemodel, a LIST has batches of 64 pairs of views of 192x144 (docs/trained.md). It rewrites
places.caffemodel. The loss is that of trained_head.py, plus the difference between the cosines of a batch's views
and those of two teachers, the other words and the original net (Hinton, Vinyals, Dean: Distilling the Knowledge in a
Neural Network).
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

RATE, WARM, SCALE, VIEWS = 8e-4, 30, 15, 128  # learning rate, iterations until it is reached, and views per batch
OWN = 0.3  # weight of the original net as a teacher
folder, iterations, start, lists = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3], [Path(n) for n in sys.argv[4:]]
places = [folder / f"places.{kind}" for kind in ("prototxt", "caffemodel")]
both = Path(__file__).parents[2] / "prototxt" / "many_negatives" / "siamese_words_256" / "train_val.prototxt"
net, tower = read_net(both), folder / "tower.prototxt"
names = [layer.name for layer in net.layer]
del net.layer[names.index("parts") + 1 :], net.layer[: names.index("input")]
data = 'layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 128 dim: 3 dim: 96 dim: 128 } } }'
tower.write_text(f"{data}\n{write_text(net)}")
teacher = Describer(*places, blob="head_feat").image_net
own, words = (netspec.load_net(tower, phase, start, exact="none") for phase in ("TEST", "TRAIN"))
views, like = [], []
for each in lists:
    files = [each.parent / name for pair in read_pair_list(each) for name in (pair.first, pair.second)]
    for k in range(0, len(files), VIEWS):
        images = [cv2.imread(str(file)) for file in files[k : k + VIEWS]]
        small = [cv2.resize(image, (128, 96), interpolation=cv2.INTER_AREA) for image in images]
        views.append(np.array(small).transpose(0, 3, 1, 2))
        feats = torch.from_numpy(teacher(images))
        with torch.no_grad():
            units = own(data=torch.from_numpy(views[-1]).float())
        like.append(20 * (1 - OWN) * feats @ feats.T)
        like[-1] += SCALE * OWN * sum(units[name] @ units[name].T for name in ("whole", "parts")) / 2
optimizer, rng = torch.optim.AdamW(words.parameters(), weight_decay=1e-3), np.random.default_rng(1)
itself, partner, order = 1e4 * torch.eye(VIEWS), torch.arange(VIEWS) ^ 1, []  # views 0 and 1 are a pair, 2 and 3, ...
others = (itself == 0).index_put((torch.arange(VIEWS), partner), torch.tensor(False))
for k in range(iterations):
    order = order or rng.permutation(len(views)).tolist()
    batch = order.pop()
    cut = torch.zeros(VIEWS, 2, 3)  # a part of each view, mirrored in half of the batches
    cut[:, 0, 0] = cut[:, 1, 1] = torch.from_numpy(rng.uniform(0.8, 1, VIEWS))
    cut[:, :, 2] = torch.from_numpy(rng.uniform(-1, 1, (VIEWS, 2))) * (1 - cut[:, 0, :1])
    cut[:, 0, 0] *= rng.choice((-1, 1))
    x = torch.from_numpy(views[batch]).float()
    x = functional.grid_sample(x, functional.affine_grid(cut, list(x.shape), False), align_corners=False)
    # Without instructions for bfloat16, it would be slower.
    with torch.autocast("cpu", torch.bfloat16, enabled=torch.ops.mkldnn._is_mkldnn_bf16_supported()):
        units = words(data=x)
    whole, parts = (SCALE * units[name].float() @ units[name].float().T for name in ("whole", "parts"))
    loss = torch.zeros(())
    for cosines in (whole, parts):
        loss = loss + functional.cross_entropy(cosines - itself, partner)
        learned = functional.log_softmax(cosines - itself, 1)
        loss = loss + functional.kl_div(learned, functional.softmax(like[batch] - itself, 1), reduction="batchmean")
    for cosines in (whole, parts, (whole + parts) / 2):  # each pair against all others of the batch
        first = cosines[others].logsumexp(0) - cosines[torch.arange(VIEWS), partner]
        loss = loss + functional.softplus(first).mean() / 1.5
    optimizer.param_groups[0]["lr"] = RATE * min(1, (k + 1) / WARM) * (0.51 + 0.49 * np.cos(np.pi * k / iterations))
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
netspec.save_weights(words, folder / "words.caffemodel")
taught = caffe.Net(str(places[0]), caffe.TEST)
for weights in (places[1], folder / "words.caffemodel"):
    taught.copy_from(str(weights))
taught.save(str(places[1]))
print(f"{places[1]}: {len(views)} batches, loss {loss.item():.3f}")

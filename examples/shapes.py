"""Draws images of shapes with their boxes for mobilenet_ssd.py and faster_rcnn.py, and judges what a net finds.

A true box is a row: kind (from 1), x1, y1, x2, y2 as fractions of the image. A found box has its confidence second.
"""

import cv2
import lmdb
import numpy as np

import netspec
import netspec.pycaffe as caffe

COLORS = ((255, 255, 255), (0, 0, 255), (0, 255, 255), (255, 128, 0))  # of true boxes, and of found ones by kind


def render(random, size=96):
    """Return an image of one to three discs, squares and triangles, and their boxes (n, 5)."""
    image = cv2.resize(random.randint(60, 200, (4, 4, 3)).astype(np.uint8), (size, size))
    boxes, cell = [], size // 2
    for place in random.permutation(4)[: random.randint(1, 4)]:
        kind, side, color = random.randint(3), int(random.randint(cell // 2, cell)), random.randint(0, 256, 3).tolist()
        left, low = (int(at * cell + random.randint(0, cell - side)) for at in (place % 2, place // 2))
        right, high, middle = left + side, low + side, left + side // 2
        if kind == 0:
            cv2.circle(image, (middle, low + side // 2), side // 2, color, -1)
        else:
            top = [(left, low), (right, low)] if kind == 1 else [(middle, low)]
            cv2.fillPoly(image, [np.array([*top, (right, high), (left, high)])], color)
        boxes.append([kind + 1, left / size, low / size, right / size, high / size])
    return image, np.array(boxes)


def write(path, images):
    """Write images with their boxes as a database for SSD's layer AnnotatedData."""
    netspec.use_dialect("ssd")
    with lmdb.open(path, map_size=1 << 30) as database, database.begin(write=True) as writer:
        for i, (image, boxes) in enumerate(images):
            record = caffe.proto.caffe_pb2.AnnotatedDatum(type=0)
            record.datum.encoded, record.datum.data = True, cv2.imencode(".png", image)[1].tobytes()
            for kind, *corners in boxes:
                box = record.annotation_group.add(group_label=int(kind)).annotation.add().bbox
                box.xmin, box.ymin, box.xmax, box.ymax = corners
            writer.put(b"%05d" % i, record.SerializeToString())


def judge(images, found, path, least=0.5):
    """Print precision and recall of the boxes (n, 6) with at least confidence ``least``; draw ten images."""
    right, tiles, found = 0, [], [boxes[boxes[:, 1] >= least] for boxes in found]
    for (image, true), boxes in zip(images, found, strict=True):
        tiles.append(cv2.resize(image, (256, 256)))
        for kind, *corners in [*np.insert(true[:, 1:], 0, 0, axis=1), *np.delete(boxes, 1, axis=1)]:
            ends = [tuple(int(256 * x) for x in end) for end in (corners[:2], corners[2:])]
            cv2.rectangle(tiles[-1], *ends, COLORS[int(kind)], 2 if kind else 5)
        for kind, *corners in true:
            low, high = np.maximum(boxes[:, 2:4], corners[:2]), np.minimum(boxes[:, 4:], corners[2:])
            both, own = np.maximum(high - low, 0).prod(axis=1), (corners[2] - corners[0]) * (corners[3] - corners[1])
            either = (boxes[:, 4:] - boxes[:, 2:4]).prod(axis=1) + own - both
            right += bool(((both > either / 2) & (boxes[:, 0] == kind)).any())
    cv2.imwrite(path, np.vstack([np.hstack(tiles[i : i + 5]) for i in range(0, min(len(tiles), 10), 5)]))
    shown, there = max(1, sum(map(len, found))), sum(len(true) for _, true in images)
    print(f"{path}: {there} boxes: precision {right / shown:.2f}, recall {right / there:.2f}")

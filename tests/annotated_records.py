"""Databases of SSD's AnnotatedDatum for tests; its dialect must be active."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from netspec.data.database import Writer
from netspec.data.datum import array_to_datum, encoded_datum
from netspec.proto.schema import message

Box = tuple[float, float, float, float]


def annotated(image: np.ndarray, objects: Sequence[tuple[int, Box, bool]], encode: bool = True) -> Any:
    datum = message("ssd.AnnotatedDatum")(type=0)
    if encode:
        pixels = cv2.imencode(".png", image)[1].tobytes()
        datum.datum.CopyFrom(encoded_datum(pixels, 7, (image.shape[2], *image.shape[:2])))
    else:
        datum.datum.CopyFrom(array_to_datum(np.ascontiguousarray(image.transpose(2, 0, 1)), 7))
    for label, members in itertools.groupby(objects, key=lambda o: o[0]):
        group = datum.annotation_group.add(group_label=label)
        for instance, (_, box, difficult) in enumerate(members):
            annotation = group.annotation.add(instance_id=instance)
            annotation.bbox.xmin, annotation.bbox.ymin, annotation.bbox.xmax, annotation.bbox.ymax = box
            annotation.bbox.difficult = difficult
    return datum


def write(folder: Path, *datums: Any) -> Path:
    with Writer(str(folder / "lmdb")) as writer:
        for i, datum in enumerate(datums):
            writer.put(b"%04d" % i, datum.SerializeToString())
    return folder / "lmdb"

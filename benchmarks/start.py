"""A process that loads a net, describes one image and ends: ``python -m benchmarks.start TASK``.

Prints as JSON the seconds of importing torch (0 if it is not needed) and the CPU seconds of everything else.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any

Task = dict[str, Any]
MEAN, SCALE = 128.0, 1 / 128  # of pixels
Seconds = tuple[float, float]  # wall clock, CPU


def netspec(task: Task) -> tuple[Seconds, Any]:
    """Describe with netspec's Describer and the engine of the task."""
    seconds = _import_torch() if task["engine"] == "torch" else (0.0, 0.0)
    import cv2

    from netspec.inspect.features.describer import Describer

    engine, precision, cache = task["engine"], task["precision"], task["cache"]
    describe = Describer(
        task["prototxt"],
        task["caffemodel"],
        task["outputs"][0],
        mean=MEAN,
        scale=SCALE,
        engine=engine,
        precision=precision,
        cache=cache,
    )
    image: Any = cv2.imread(task["image"])
    return seconds, describe(image)


def opencv4(task: Task) -> tuple[Seconds, Any]:
    """Describe with OpenCV 4's importer."""
    import cv2

    net = cv2.dnn.readNetFromCaffe(task["prototxt"], task["caffemodel"])  # type: ignore[attr-defined]
    _, _, height, width = task["shape"]
    image: Any = cv2.imread(task["image"])
    net.setInput(cv2.dnn.blobFromImage(image, SCALE, (width, height), (MEAN,) * 3))
    return (0.0, 0.0), net.forward()


PROGRAMS: dict[str, Callable[[Task], tuple[Seconds, Any]]] = {"netspec": netspec, "opencv4": opencv4}


def _import_torch() -> Seconds:
    began = time.perf_counter(), time.process_time()
    import torch  # noqa: F401

    return time.perf_counter() - began[0], time.process_time() - began[1]


def main() -> None:
    """Run the task and print the times."""
    import numpy as np

    task = json.loads(sys.argv[1])
    seconds, values = PROGRAMS[task["program"]](task)
    np.savez(task["result"], allow_pickle=False, **{task["outputs"][0]: np.asarray(values)})
    print(json.dumps({"torch": seconds[0], "computing": time.process_time() - seconds[1]}))


if __name__ == "__main__":
    main()

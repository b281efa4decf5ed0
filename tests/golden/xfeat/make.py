"""Writes onnx.npz: outputs of XFeat's ONNX model, run by onnxruntime, at some cells of a drawn image.

python make.py xfeat_640x640.onnx
"""

import sys
from pathlib import Path

import numpy as np
import onnxruntime


def image() -> np.ndarray:
    """Return squares of random gray, of 20 and of 8 pixels, (640, 640) float32."""
    rng = np.random.default_rng(1)
    squares = [np.kron(rng.integers(0, 128, (640 // side,) * 2), np.ones((side, side))) for side in (20, 8)]
    return np.sum(squares, axis=0).astype(np.float32)


def main() -> None:
    """Run the model."""
    pixels = image()
    session = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
    outputs = session.run(None, {"input": ((pixels - pixels.mean()) / pixels.std())[None, None]})
    descriptors, logits, reliability = (np.squeeze(np.asarray(output)) for output in outputs)
    cells = np.concatenate([[[0, 0], [0, 79], [79, 0], [79, 79]], np.random.default_rng(2).integers(0, 80, (16, 2))])
    row, column = cells.T
    np.savez_compressed(
        Path(__file__).with_name("onnx.npz"),
        cells=cells.astype(np.int16),
        descriptors=descriptors[row, column],
        logits=logits[row, column],
        reliability=reliability[row, column],
    )


if __name__ == "__main__":
    main()

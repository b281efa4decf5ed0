"""A function of the user's as a method."""

import pytest

from loopclosure.errors import InputError
from loopclosure.evaluate import evaluate, named_method
from loopclosure.methods.base import MethodContext, make_method
from loopclosure.places.datasets import load_tum

MEANS = """
import cv2

def describe(image):
    return cv2.resize(image, (8, 6), interpolation=cv2.INTER_AREA).reshape(-1) / 255.0

def growing(image, sizes=[]):
    sizes.append(1)
    return sizes
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "means.py"
    path.write_text(MEANS)
    return path


def test_a_function_describes_the_images(file, two_laps):
    data = load_tum(two_laps)
    methods = [named_method(f"describe:{file}:describe{metric}", MethodContext()) for metric in ("", ":cosine")]
    euclidean, cosine = evaluate(data, methods).outcomes
    assert euclidean.name == f"{file}:describe (euclidean)"
    assert euclidean.recall_at[1] == cosine.recall_at[1] == 1.0
    assert euclidean.notes[0] == "144 dimensions, euclidean"
    assert set(euclidean.seconds) == {"loading", "descriptors", "similarity"}


def test_descriptors_of_different_lengths_are_refused(file, two_laps):
    method = named_method(f"describe:{file}:growing", MethodContext())
    with pytest.raises(InputError, match="growing gave 2 numbers, and 1 before"):
        evaluate(load_tum(two_laps), [method])


@pytest.mark.parametrize("spec", ["describe", "describe:cosine", "describe:net.py", "describe:net.py:cosine"])
def test_a_function_must_be_named(spec):
    with pytest.raises(InputError, match="expected describe:"):
        make_method(spec)

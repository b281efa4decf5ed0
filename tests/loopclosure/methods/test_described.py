"""A function of the user's as a method."""

from pathlib import Path

import pytest

from loopclosure.errors import InputError
from loopclosure.evaluation import evaluate
from loopclosure.methods.named import make_method, named_methods
from loopclosure.places.datasets import load_sequence
from loopclosure.places.sequences import read_sequence

MEANS = (Path(__file__).parent / "programs" / "means.py").read_text()


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "means.py"
    path.write_text(MEANS)
    return path


def test_a_function_describes_the_images(file, two_laps):
    data = load_sequence(read_sequence(two_laps, "tum"))
    spec = f"describe:{file}:describe"
    methods = named_methods([spec, f"cosine={spec}"], settings={"cosine.metric": "cosine"})
    euclidean, cosine = evaluate(data, methods).outcomes
    assert euclidean.name == f"{file}:describe (euclidean)"
    assert euclidean.recall_at[1] == cosine.recall_at[1] == 1.0
    assert euclidean.notes[0] == "144 dimensions, euclidean"
    assert set(euclidean.seconds) == {"loading", "descriptors", "similarity"}


def test_descriptors_of_different_lengths_are_refused(file, two_laps):
    method = ("growing", make_method(f"describe:{file}:growing"))
    with pytest.raises(InputError, match="growing gave 2 numbers, and 1 before"):
        evaluate(load_sequence(read_sequence(two_laps, "tum")), [method])


@pytest.mark.parametrize("spec", ["describe", "describe:net.py", "describe:net.py:"])
def test_a_function_must_be_named(spec):
    with pytest.raises(InputError, match="expected describe:"):
        make_method(spec)

"""The online detector judged as a method."""

import numpy as np
import pytest

from loopclosure.errors import InputError
from loopclosure.evaluate import evaluate, named_method
from loopclosure.methods.base import Images, MethodContext, make_method
from loopclosure.places.datasets import load_tum
from loopclosure.progress import silent


def test_it_scores_only_what_it_accepts(two_laps, two_laps_features):
    data = load_tum(two_laps)
    context = MethodContext(data.exclude_frames)
    spec = f"detector:{two_laps_features}:threshold=-0.3,consistency=2"
    (outcome,) = evaluate(data, [named_method(spec, context)]).outcomes
    assert np.argwhere(np.isfinite(outcome.scores)).tolist() == [[i, i - 20] for i in range(22, 40)]
    assert outcome.best.precision.tolist() == [1.0] * len(outcome.best.precision)
    assert outcome.measures["best match of each query"]["recall at 100 % precision"] == pytest.approx(18 / 20)
    assert outcome.answer.startswith("frames: 10 no candidate")
    assert "best score" in outcome.answer
    assert "precision 1.000, recall 0.900" in outcome.answer


@pytest.mark.slow
def test_without_a_threshold_its_candidates_are_verified(two_laps, two_laps_features):
    method = make_method(f"detector:{two_laps_features}:verify=yes,min_inliers=500", MethodContext(9))
    result = method.score(Images(load_tum(two_laps).query_images), silent)
    assert not np.isfinite(result.scores).any()
    assert "30 not verified" in result.answer


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("detector", "expected detector:FILE.npz, or"),
        ("detector:a.npz:calibrate=b", 'has no setting "calibrate=b"'),
        ("detector:a.npz:threshold=-1,top_k=0", "top_k is 0"),
        ("detector+thumbnails", "works on images, not on the scores"),
    ],
)
def test_what_makes_no_sense_is_said(spec, message):
    with pytest.raises(InputError, match=message):
        make_method(spec)


def test_two_traverses_are_refused(two_laps, two_laps_features):
    images = load_tum(two_laps).query_images
    method = make_method(f"detector:{two_laps_features}:threshold=-1")
    with pytest.raises(InputError, match="finds loops in one sequence"):
        method.score(Images(images, images), silent)

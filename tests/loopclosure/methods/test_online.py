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
    assert any(note.startswith("frames: 10 no candidate") for note in outcome.notes)


def test_its_threshold_is_calibrated_and_candidates_verified(two_laps, two_laps_features):
    settings = f"calibrate={two_laps},calibrate_features={two_laps_features},verify=yes,inliers=500,max_features=500"
    method = make_method(f"detector:{two_laps_features}:{settings}", MethodContext(9))
    images = load_tum(two_laps).query_images
    result = method.score(Images(images), silent)
    assert not np.isfinite(result.scores).any()
    assert result.notes[0].startswith("threshold -")
    assert "20 not verified" in result.notes[1]
    assert result.training_stages == ("calibration",)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("detector", "expected detector:FILE.npz:threshold=T"),
        ("detector:a.npz", "either threshold=T or calibrate=SEQUENCE"),
        ("detector:a.npz:threshold=1,calibrate=b", "either threshold=T or calibrate=SEQUENCE"),
        ("detector:a.npz:calibrate=b", "needs calibrate_features"),
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

"""A method that returns given scores."""

from loopclosure.methods.base import MethodResult


class GivenScores:
    """A method that returns a MethodResult of ``scores`` (Q, R), and of ``others``, its further fields."""

    name = "given"

    def __init__(self, scores, *others):
        self.result = MethodResult(scores, *others)

    def score(self, images, progress):
        return self.result

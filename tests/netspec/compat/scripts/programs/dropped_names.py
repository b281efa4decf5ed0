import collections, time, unittest
import numpy as np
from scipy.misc import imread, imresize, imsave, factorial
import scipy.ndimage
assert (np.float, np.int, np.object, np.bool(1), np.Inf) == (float, int, object, True, float("inf"))
image = np.zeros((4, 6, 3)); image[:2] = 1
imsave("a.png", image)
assert imread("a.png").dtype == np.uint8 and imread("a.png").max() == 255
assert imread("a.png", flatten=True).shape == (4, 6)
assert imresize(imread("a.png"), (8, 12)).shape == (8, 12, 3)
assert imresize(imread("a.png"), 50).shape == imresize(imread("a.png"), 0.5).shape == (2, 3, 3)
assert scipy.ndimage.imread("a.png").shape == (4, 6, 3)
assert np.fromstring(np.arange(3).tostring(), dtype=int).tolist() == [0, 1, 2]
assert np.fromstring("1 2", sep=" ").tolist() == [1, 2]
assert set(np.random.random_integers(1, 2, 50)) == {1, 2}
assert isinstance({}, collections.Mapping) and time.clock() >= 0
unittest.TestCase().assertEquals(1, 1)
print("fine")

import numpy as np
import caffe

class TimesTen(caffe.Layer):
    """Caffe's own first example."""

    def setup(self, bottom, top):
        pass

    def reshape(self, bottom, top):
        top[0].reshape(*bottom[0].data.shape)

    def forward(self, bottom, top):
        top[0].data[...] = 10 * bottom[0].data

    def backward(self, top, propagate_down, bottom):
        bottom[0].diff[...] = 10 * top[0].diff


class Euclidean(caffe.Layer):
    """Caffe's second: a loss of two bottoms, with a buffer of its own."""

    def setup(self, bottom, top):
        if len(bottom) != 2:
            raise Exception("Need two inputs to compute distance.")

    def reshape(self, bottom, top):
        if bottom[0].count != bottom[1].count:
            raise Exception("Inputs must have the same dimension.")
        self.diff = np.zeros_like(bottom[0].data, dtype=np.float32)
        top[0].reshape(1)

    def forward(self, bottom, top):
        self.diff[...] = bottom[0].data - bottom[1].data
        top[0].data[...] = np.sum(self.diff**2) / bottom[0].num / 2.

    def backward(self, top, propagate_down, bottom):
        self.asked = list(propagate_down)
        for i in range(2):
            if not propagate_down[i]:
                continue
            if i == 0:
                sign = 1
            else:
                sign = -1
            bottom[i].diff[...] = sign * self.diff / bottom[i].num


class Count(caffe.Layer):
    """A data layer: no bottoms, a state, parameters in param_str."""

    def setup(self, bottom, top):
        self.size = eval(self.param_str)["size"]
        assert self.param_str_ == self.param_str
        self.next = 0
        top[0].reshape(self.size)

    def reshape(self, bottom, top):
        pass

    def forward(self, bottom, top):
        top[0].data[...] = np.arange(self.next, self.next + self.size)
        self.next += self.size

    def backward(self, top, propagate_down, bottom):
        pass


class Learned(caffe.Layer):
    """Blobs of its own."""

    def setup(self, bottom, top):
        self.blobs.add_blob(2, 3)
        self.blobs.add_blob(1)
        self.blobs[0].data[...] = 0.5

    def reshape(self, bottom, top):
        top[0].reshape(bottom[0].num, 2)

    def forward(self, bottom, top):
        top[0].data[...] = bottom[0].data.dot(self.blobs[0].data.T) + self.blobs[1].data

    def backward(self, top, propagate_down, bottom):
        self.blobs[0].diff[...] += top[0].diff.T.dot(bottom[0].data)
        self.blobs[1].diff[...] += top[0].diff.sum()
        bottom[0].diff[...] = top[0].diff.dot(self.blobs[0].data)


class Half(caffe.Layer):
    """A top with a shape that is known only in forward; a lazy import; the phase."""

    def forward(self, bottom, top):
        import caffe
        n = bottom[0].num // 2 if self.phase == caffe.TRAIN else bottom[0].num
        top[0].reshape(n, bottom[0].channels, bottom[0].height, bottom[0].width)
        top[0].data[...] = bottom[0].data[:n].reshape(top[0].shape)


class Look(caffe.Layer):
    """Does nothing to the blob that it works on in place."""

    def forward(self, bottom, top):
        self.seen = bottom[0].data.copy()

    def backward(self, top, propagate_down, bottom):
        self.seen_diff = top[0].diff.copy()


class Doubler(Look):
    """Works on the one blob that is its bottom and its top."""

    def forward(self, bottom, top):
        bottom[0].data[...] *= 2

    def backward(self, top, propagate_down, bottom):
        bottom[0].diff[...] *= 2


class NoLayer(object):
    def __init__(self, param):
        pass


class Broken(caffe.Layer):
    def setup(self, bottom, top):
        raise RuntimeError("setup of a broken layer")


class Breaks(TimesTen):
    def forward(self, bottom, top):
        raise ZeroDivisionError("forward of a broken layer")


class One(caffe.Layer):
    def setup(self, bottom, top):
        self.blobs.add_blob(1)
        self.blobs[0].data[0] = 0

    def reshape(self, bottom, top):
        top[0].reshape(1)

    def forward(self, bottom, top):
        top[0].data[0] = self.blobs[0].data[0]

    def backward(self, top, propagate_down, bottom):
        self.blobs[0].diff[0] = 1


class Phase(caffe.Layer):
    def setup(self, bottom, top):
        pass

    def reshape(self, bottom, top):
        top[0].reshape()

    def forward(self, bottom, top):
        top[0].data[()] = self.phase


class Rows(caffe.Layer):
    """A data layer as in Fast R-CNN, which gets its records from the script."""

    def setup(self, bottom, top):
        self.kept = top
        top[0].reshape(1, 2)
        top[1].reshape(1)
        top[1].data[...] = 7

    def set_rows(self, rows):
        self.rows, self.next = rows, 0

    def reshape(self, bottom, top):
        pass

    def forward(self, bottom, top):
        row = self.rows[self.next]
        self.next = (self.next + 1) % len(self.rows)
        top[0].reshape(1, len(row))
        top[0].data[...] = row

    def backward(self, top, propagate_down, bottom):
        pass

"""Python layers that prefetch in a separate process, like those of R-CNN."""

import atexit
import multiprocessing

import caffe  # pyright: ignore[reportMissingImports]
import numpy as np

FORK = multiprocessing.get_context("fork")


def fill(queue):
    while True:
        queue.put(np.ones((2, 3), "f4"))


class Daemon(caffe.Layer):
    """Leaves the end of its process to multiprocessing."""

    def setup(self, bottom, top):
        self.queue = FORK.Queue(3)
        self.worker = FORK.Process(target=fill, args=(self.queue,), daemon=self.daemon)
        self.worker.start()

    daemon = True

    def reshape(self, bottom, top):
        top[0].reshape(2, 3)

    def forward(self, bottom, top):
        top[0].data[...] = self.queue.get()

    def backward(self, top, propagate_down, bottom):
        pass


class Joined(Daemon):
    """Ends its process itself."""

    daemon = False

    def setup(self, bottom, top):
        super().setup(bottom, top)
        atexit.register(self.cleanup)

    def cleanup(self):
        self.worker.terminate()
        self.worker.join()
        print("joined")


class Pooled(Daemon):
    """Has a pool of processes make each batch."""

    def setup(self, bottom, top):
        self.pool = FORK.Pool(2)
        atexit.register(self.cleanup)

    def cleanup(self):
        self.pool.terminate()
        self.pool.join()

    def forward(self, bottom, top):
        top[0].data[...] = self.pool.apply_async(np.ones, ((2, 3),)).get()

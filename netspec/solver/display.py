"""What a training shows every ``display`` iterations.

Caffe: Solver::Step (src/caffe/solver.cpp)
"""

from __future__ import annotations

from netspec import log
from netspec.layers.contract.reading import Waits, reads_data
from netspec.solver.tally import as_scores
from netspec.solver.testing import log_scores
from netspec.solver.training import Blobs, Training


class Display:
    """Logs the pace, the loss, the outputs, and how long the training waited for data."""

    def __init__(self, training: Training) -> None:
        self._training = training
        self._reads = any(reads_data(layer) for layer in training.net.layers)
        self._waiting = [layer for layer in training.net.layers if isinstance(layer, Waits)]

    def begin(self) -> None:
        """Start the clock."""
        self._time, self._iteration = self._training.options.clock(), self._training.iteration
        self._waited = self._seconds_waited()

    def show(self, outputs: Blobs) -> None:
        """Log one display, since the last one."""
        training = self._training
        now, waited = training.options.clock(), self._seconds_waited()
        seconds = now - self._time
        speed = (training.iteration - self._iteration) / (seconds or 1)
        pace = f"{log.number(speed)} iter/s, {log.number(seconds)}s/{training.param.display} iters"
        log.info("solver.cpp:239", f"Iteration {training.iteration} ({pace}), loss = {log.number(training.loss)}")
        log_scores("solver.cpp:258", "Train", as_scores(outputs), training.net.output_loss_weights)
        if self._reads:
            share = 100 * (waited - self._waited) / (seconds or 1)
            log.info("blocking_queue.cpp:49", f"Waiting for data: {share:.1f} % of the time")
        self._time, self._iteration, self._waited = now, training.iteration, waited

    def _seconds_waited(self) -> float:
        return sum(layer.waited for layer in self._waiting)

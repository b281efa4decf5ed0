"""The gradients of a training, from clear to update.

Caffe: SGDSolver::ApplyUpdate, SGDSolver::GetLearningRate (src/caffe/solvers/sgd_solver.cpp)
"""

from __future__ import annotations

from netspec import log
from netspec.solver import update
from netspec.solver.lr_policy import learning_rate, next_step
from netspec.solver.precision import FP16
from netspec.solver.training import Training


class Updates:
    """Turns the gradients of a training into new weights."""

    def __init__(self, training: Training) -> None:
        self._training = training
        self._overflowed = False

    def reduce(self) -> None:
        """Make the gradients the mean over all devices, without the loss scale.

        Where one has overflowed float16, this iteration will update nothing.
        """
        training, scale = self._training, self._training.scale
        training.replicas.reduce()
        if training.options.precision != FP16:
            return
        gradients = [item.parameter.grad for item in training.net.learnable if item.parameter.grad is not None]
        self._overflowed = not scale.remove(gradients)
        if self._overflowed:
            factor = log.number(scale.factor)
            log.info("sgd_solver.cpp:99", f"Iteration {training.iteration}: float16 overflowed; loss scale {factor}")
            if scale.factor < 1:
                training.tell_nan("the gradients overflow float16")

    def apply(self) -> None:
        """Update the weights and count the iteration; an iteration whose gradients overflowed is counted only."""
        training, param = self._training, self._training.param
        rate = self._advance_rate()
        if training.is_due(param.display):
            log.info("sgd_solver.cpp:112", f"Iteration {training.iteration}, lr = {log.number(rate)}")
        if not self._overflowed:
            if param.clip_gradients >= 0 and (clipped := update.clip(training.blocks.diffs(), param.clip_gradients)):
                norm, factor = map(log.number, clipped)
                found = f"L2 norm {norm} > {log.number(param.clip_gradients)}"
                message = f"Gradient clipping: scaling down gradients ({found}) by scale factor {factor}"
                log.info("sgd_solver.cpp:99", message)
            for piece in training.blocks.pieces(rate, param.weight_decay):
                update.move(training.rule, param, piece, training.iteration)
            training.replicas.update()
        training.iteration += 1

    def _advance_rate(self) -> float:
        training, param = self._training, self._training.param
        step = next_step(param, training.iteration, training.current_step)
        if step != training.current_step and param.lr_policy == "multistep":
            log.info("sgd_solver.cpp:50", f"MultiStep Status: Iteration {training.iteration}, step = {step}")
        training.current_step = step
        return learning_rate(param, training.iteration, step)

"""Damped Gauss-Newton descent of a loss (Marquardt 1963, J. SIAM 11), whose caller confines the steps."""

from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np

from reactorwatch.arrays import Array

CONVERGED = 0.05
"""Gain in log likelihood below which a descent ends."""

DAMPING = 1e-3, 10.0
"""Damping of the first step, as a fraction of the information, and its factor after a step without a gain."""

NEARLY_LINEAR = 1e-6, 100.0
"""The same for parameters in which the model is nearly linear, but which can imitate each other."""

_TRIES, _LESS_DAMPING = 5, 0.1


class Point(Protocol):
    """Parameters with their loss: minus the logarithm of the likelihood and of the prior."""

    @property
    def loss(self) -> float:
        """The loss."""


P = TypeVar("P", bound=Point)

Equations = tuple[Array, Array]
"""Information, shape (n, n), and gradient of the log likelihood, shape (n,)."""


def descend(
    start: P,
    equations: Callable[[P], Equations | None],
    move: Callable[[P, Array], P | None],
    steps: int,
    enough: float = CONVERGED,
    dampings: tuple[float, float] = DAMPING,
) -> P:
    """Descend from a point to one with a smaller loss.

    Args:
        start: first point.
        equations: normal equations at a point; None, or not finite: the descent ends there.
        move: the point after a step, shortened where it would leave the trust region or a bound; None: the model
            diverges there.
        steps: maximum number of steps.
        enough: gain in log likelihood that is not worth a step.
        dampings: damping of the first step, and its factor after a step without a gain.
    """
    best, (first, more) = start, dampings
    damping = first
    for _ in range(steps):
        known = equations(best)
        if known is None or not np.all(np.isfinite(known[0])):
            break
        information, gradient = known
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        with np.errstate(over="ignore"):
            information, gradient = information / np.outer(scale, scale), gradient / scale
        if not np.all(np.isfinite(information)):  # a parameter without effect beside one with an enormous one
            break
        before, promised = best, 0.0
        for _ in range(_TRIES):
            scaled = np.linalg.lstsq(information + damping * np.eye(scale.size), gradient, rcond=1e-12)[0]
            promised = float(scaled @ (gradient - 0.5 * information @ scaled))
            if promised < enough:
                break
            trial = move(best, scaled / scale)
            if trial is not None and trial.loss < best.loss:
                best, damping = trial, damping * _LESS_DAMPING
                break
            damping *= more
        gained = before.loss - best.loss
        # A full step that gains what was predicted shows that the loss is quadratic here: nothing remains to gain.
        if gained < CONVERGED or (damping < first and abs(gained - promised) < enough):
            break
    return best

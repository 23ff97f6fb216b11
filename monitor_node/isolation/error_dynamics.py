"""The equations of a filter's own errors over a window, with respect to the sizes of all effects, a product a row."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from monitor_node.isolation.window import Window
from reactorwatch.arrays import Array
from reactorwatch.kalman.ekf import NoiseLevels
from reactorwatch.kalman.ekf_step import MODEL_CACHE_SIZE
from reactorwatch.kalman.error_dynamics import ErrorLinearization
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel


@dataclass(frozen=True, eq=False)
class Ways:
    """From each row but the last to the next one: the first axis has one place a way.

    Attributes:
        A: d (the filter's state, what it is off by, whitened) / d its state before, shape (n_x + n_y, n_x).
        G: likewise by the sizes, through what they do on the way, shape (n_x + n_y, causes).
        D: likewise by the sizes, through what they do to the outputs, shape (n_x + n_y, causes).
        w: what it was off by, whitened, shape (n_y,); 0 where nothing was measured.
    """

    A: Array
    G: Array
    D: Array
    w: Array


def linearisable(model: ProcessModel, effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """The effects that act on the model's own states: from no new state there is no infinitesimal deviation."""
    return tuple(effect for effect in effects if effect.extend(model).state_names == model.state_names)


class Linearisation:
    """Linearises the filter of a model.

    Args:
        model: of the plant.
        noise: of the plant and its sensors.
        effects: whose sizes to differentiate by; each acts on the model's own states.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, effects: Sequence[Effect]) -> None:
        self._errors = _compiled(model, tuple(effects)).with_noise(noise)

    def prepare(self) -> None:
        """Compile now what the first call of `ways` would compile."""
        self._errors.prepare()

    def ways(self, window: Window) -> Ways:
        """Those between the rows of a window."""
        ways = self._errors.dynamics(
            window.time_min,
            window.inputs,
            window.x,
            window.covariance,
            window.residual,
            window.used,
            uncertainty=window.uncertainty,
        )
        by_state = np.concatenate([np.eye(ways.F.shape[1]) - ways.K @ ways.H, ways.whitening @ ways.H], axis=1)
        by_shown = np.concatenate([-ways.K, ways.whitening], axis=1)
        return Ways(by_state @ ways.F, by_state @ ways.G, by_shown @ ways.D, ways.w)


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def _compiled(model: ProcessModel, effects: tuple[Effect, ...]) -> ErrorLinearization:
    """With all effects in the model, and some noise."""
    symbols = []
    for effect in effects:
        model = effect.extend(model)
        symbols.append(model.parameters[-1].symbol)
    return ErrorLinearization(
        model, NoiseLevels((1.0,) * len(model.outputs), (0.0,) * len(model.states)), symbols, symbols
    )

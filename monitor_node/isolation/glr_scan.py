"""Generalised likelihood ratio of every cause at every onset, linearised about the filter's run.

For each cause, as a step and as a ramp that starts right after a row, `diagnosis.fitting.signatures` gives
a = sum(g w) and b = sum(g g), with w the normalised innovations and g the signature of a deviation of size 1. The
likeliest size is a / b, its variance 1 / b, and twice the logarithm of the likelihood ratio a^2 / b. One pass backwards
over the rows gives all onsets of all causes: 0.7 ms for 600 rows.

The signature is that of an infinitesimal size. A large fault soon leads the plant out of its range, so there are two
scans: of the rows up to the first at which some cause stands out by `STANDS_OUT`, and of all.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from monitor_node.isolation.window import BURN_IN_ROWS, Window
from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.augmented_model import augment_model
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.diagnosis.run import input_uncertainty_of
from reactorwatch.kalman.ekf import NoiseLevels
from reactorwatch.kalman.error_dynamics import ErrorDynamics
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel

STANDS_OUT = 60.0
"""Twice a logarithm of a likelihood ratio."""

REACH = 30.0
"""Twice a logarithm of a likelihood ratio: an onset that is worse than the best one by more is out of question."""


@dataclass(frozen=True, eq=False)
class Scan:
    """Result of a scan.

    Attributes:
        rows: number of rows of the scan.
        onset_min: onsets, shape (n,), increasing.
        size: the likeliest size, shape (n, profiles, causes).
        ratio: twice the logarithm of its likelihood ratio, same shape; minus infinity: not known.
        information: 1 / variance of the size, same shape.
    """

    rows: int
    onset_min: Array
    size: Array
    ratio: Array
    information: Array

    @property
    def stands_out(self) -> bool:
        """True if the likelihood ratio of some cause is that of more than noise."""
        return bool(np.max(self.ratio) > STANDS_OUT)


class GlrScan:
    """Scans windows of one plant.

    Args:
        model: process model of the plant.
        noise: noise levels of the plant and its sensors.
        effects: effects of the causes; none may add states.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, effects: Sequence[Effect]) -> None:
        self._lower = np.array([effect.lower for effect in effects])
        self._upper = np.array([effect.upper for effect in effects])
        self._augmented = augment_model(model, tuple(effects))
        self._errors = self._augmented.errors.with_noise(noise)

    def prepare(self) -> None:
        """Compile now what the first scan would compile."""
        self._errors.prepare()
        n_x, n_u, n_y = (len(item) for item in (self._errors.model.states, self._lower, self._errors.model.outputs))
        dynamics = ErrorDynamics(*(np.zeros((1, *shape)) for shape in ((n_x, n_x), (n_x, n_u), (n_y, n_x), (n_y, n_u))),
                    *(np.zeros((1, *shape)) for shape in ((n_x, n_y), (n_y, n_y), (n_y,))))  # fmt: skip
        self._scan_rows(np.array([0.0, 1.0]), dynamics, 0, 2)

    def scan(self, window: Window) -> tuple[Scan, Scan]:
        """Scan the rows up to the first in which a cause stands out, and all rows.

        Args:
            window: rows and the filter's run over them. Where the filter has diverged signatures may overflow; the
                ratio is then minus infinity.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            return self._scan_both(window)

    def _scan_both(self, window: Window) -> tuple[Scan, Scan]:
        times, first, rows, dynamics = window.time_min, BURN_IN_ROWS, window.time_min.size, self.dynamics(window)
        full = self._scan_rows(times, dynamics, first, rows)
        if not full.stands_out:
            return full, full
        early, most_without = full, first + 1  # the largest known number of rows in which nothing stands out
        while early.rows - most_without > 1:
            middle = self._scan_rows(times, dynamics, first, (early.rows + most_without) // 2)
            early, most_without = (middle, most_without) if middle.stands_out else (early, middle.rows)
        near = np.max(early.ratio, axis=(1, 2)) > np.max(early.ratio) - REACH
        before = max(int(np.argmax(near)) - 1, 0)
        arrays = (full.onset_min, full.size, full.ratio, full.information)
        return early, Scan(rows, *(item[before:] for item in arrays))

    def dynamics(self, window: Window) -> ErrorDynamics:
        """Error dynamics of the filter about its run over the window, by the sizes of the effects.

        The constants of an effect have their nominal values: without the effect no row depends on them.
        """
        nothing = np.zeros(window.time_min.size)
        inputs = self._augmented.inputs(window.time_min, window.inputs, [Signal(nothing, nothing)] * self._lower.size)
        dynamics = self._errors.dynamics(
            window.time_min,
            inputs,
            window.x,
            window.covariance,
            window.residual,
            window.used,
            uncertainty=input_uncertainty_of(window.run, inputs),
        )
        of_sizes = np.s_[:, :, : self._lower.size]
        return replace(
            dynamics, G=np.ascontiguousarray(dynamics.G[of_sizes]), D=np.ascontiguousarray(dynamics.D[of_sizes])
        )

    def _scan_rows(self, times: Array, dynamics: ErrorDynamics, first: int, rows: int) -> Scan:
        """Scan the rows before index `rows` for onsets from the row `first` on."""
        part = slice(first, rows - 1)
        dynamics = ErrorDynamics(*(getattr(dynamics, item.name)[part] for item in fields(dynamics)))
        step = np.diff(times[first:rows])[None]
        both = signatures.onset_scan(dynamics, step, np.ones_like(step), 0.5 * step)
        a, b = (np.ascontiguousarray(np.swapaxes(item, 0, 1)) for item in both)
        size = a / np.maximum(b, 1e-300)
        # The linear size of a very nonlinear cause may be beyond a bound though a possible size does the same: the less
        # heat transfer, the more a reduction does. So it keeps its ratio; a size of the wrong sign has none.
        is_impossible = np.where(size < 0.0, self._lower == 0.0, self._upper == 0.0)
        ratio = np.where(is_impossible, 0.0, a * size)
        size = np.where(is_impossible, 0.0, size)
        return Scan(rows, times[part], size, np.where(np.isfinite(ratio), ratio, -np.inf), b)

"""Simulation of a run by a model in which every effect may act a little, and its derivatives.

The state is integrated from row to row, with the inputs and all deviations at their means over each interval; nothing
is corrected by measurements. About such a simulation the states obey

    dx_{r+1} = A_r dx_r + B_r deta_r + G_r du_r,    dy_r = C_r dx_r + D_r deta_r,

with eta the sizes of the effects, u the inputs. So one pass over the rows gives the derivatives of all outputs by any
number of deviations, whatever their courses in time.

Sensors read late: the reading of an output is its value `delay` earlier, behind a first-order lag. Inputs act late in
the same way.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import CompiledFunction
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.diagnosis.inexact.noise import filter_first_order
from reactorwatch.diagnosis.run import Run
from reactorwatch.process.effect import TIMING, Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import LONGEST_STEP_MIN, symbolic_step

ACCURATE = 1e-4
"""Difference between integrations with a number of steps in a row and with twice as many, in scales of the states,
below which the smaller number is taken: a hundredth of what the noise of a good sensor is."""

DIVERGED = 1e6
"""States from which on a simulation has diverged, in their scales and first values: no plant returns from there, and
squares of what follows are still numbers."""

MOST_ROWS = 1500
"""Rows at which derivatives are kept; of a longer run every second row, or every third, and so on."""


@dataclass(frozen=True, eq=False)
class Simulated:
    """A simulation: states (rows, n_x), true outputs and errors of the sensors (rows, n_y), and what drove it."""

    x: Array
    true: Array
    errors: Array
    inputs: Array
    deviation: Signal


@dataclass(frozen=True, eq=False)
class Slopes:
    """Derivatives along a simulation: see the module; shapes (rows - 1, n_x, ...) and (rows, n_y, ...)."""

    a: Array
    b: Array
    g: Array
    c: Array
    d: Array


def acts_smoothly(model: ProcessModel, effect: Effect) -> bool:
    """True if an effect can act a little on a simulation without states of its own."""
    return (
        effect.has_derivative
        and not effect.is_source
        and effect.delays_output is None
        and not effect.constants
        and effect.location != TIMING
        and effect.extend(model).state_names == model.state_names
    )


class InexactSimulation:
    """Simulation of a run by a model with small deviations; see the module.

    Args:
        model: process model of the plant.
        effects: effects that may act; those are kept that act smoothly.
        run: the record.
        start: states at the first row, to find the steps of the integration with, shape (n_x,).

    Attributes:
        effects: the effects that are kept.
        rows: rows at which derivatives are kept.
        begins: first row of each part that is simulated by itself.
    """

    def __init__(self, model: ProcessModel, effects: Sequence[Effect], run: Run, start: Array) -> None:
        self.model, self.run = model, run
        self.effects = tuple(effect for effect in effects if acts_smoothly(model, effect))
        extended, sizes = model, list[str]()
        for effect in self.effects:
            sizes.append(f"{effect.prefix(extended)}.size")
            extended = effect.extend(extended)
        self.typical = np.array([abs(effect.typical) for effect in self.effects])
        self._neutral = np.array([effect.neutral for effect in self.effects])
        self._scales = np.array([state.scale for state in model.states])
        rows = run.time_min.size
        self.rows: NDArray[np.intp] = np.arange(0, rows, -(-rows // MOST_ROWS))
        self.begins = (0, *run.breaks)
        self._interval = np.diff(run.time_min)
        self._functions(extended, sizes)
        self._steps = 1
        self._find_steps(start)

    def _functions(self, extended: ProcessModel, sizes: Sequence[str]) -> None:
        """Compiled functions of a step and of the outputs, with their derivatives."""
        x, u, eta = (
            ca.SX.sym(name, size)
            for name, size in (("x", len(extended.states)), ("u", len(extended.inputs)), ("eta", len(sizes)))
        )
        t, h = ca.SX.sym("t"), ca.SX.sym("h")
        index = {name: number for number, name in enumerate(sizes)}
        p = ca.vertcat(*(eta[index[item.name]] if item.name in index else item.value for item in extended.parameters))
        after = symbolic_step(extended)(x, u, p, t, t + 0.5 * h, h)[0]
        shown = extended.function()(x, u, p, t, t)[1]
        of_step, of_row = [x, u, eta, t, h], [x, u, eta, t]
        step = ca.Function("step", of_step, [after])
        self._step, self._step_after_step = CompiledFunction(step), CompiledFunction(step, chained=1)
        self._step_slopes = CompiledFunction(
            ca.Function("slopes", of_step, [ca.jacobian(after, by) for by in (x, eta, u)])
        )
        self._output = CompiledFunction(ca.Function("output", of_row, [shown]))
        self._output_slopes = CompiledFunction(
            ca.Function("shown", of_row, [ca.jacobian(shown, by) for by in (x, eta)])
        )

    def _find_steps(self, start: Array) -> None:
        """Find the smallest number of steps in a row, a power of two, that is accurate."""
        scales = np.array([item.scale for item in self.model.states])
        starts, nothing = np.tile(start, (len(self.begins), 1)), self.no_deviation()
        most = float(np.median(self._interval)) / LONGEST_STEP_MIN
        coarse = self.simulate(starts, self.run.inputs[:-1], nothing)
        while self._steps < most:
            self._steps *= 2
            fine = self.simulate(starts, self.run.inputs[:-1], nothing)
            if coarse is not None and fine is not None and np.max(np.abs(fine.x - coarse.x) / scales) < ACCURATE:
                self._steps //= 2
                break
            coarse = fine

    def no_deviation(self) -> Signal:
        """All effects at their neutral sizes."""
        nothing = np.zeros((self.run.time_min.size, len(self.effects)))
        return Signal(nothing, nothing)

    def simulate(self, starts: Array, inputs: Array, deviation: Signal) -> Simulated | None:
        """Simulate; None if it diverges.

        Args:
            starts: states at the first row of each part, shape (parts, n_x).
            inputs: mean inputs from each row to the next, shape (rows - 1, n_u).
            deviation: deviations of all effects.
        """
        rows = self.run.time_min.size
        x, eta = np.empty((rows, len(self.model.states))), self._neutral + deviation.interval_mean[:-1]
        for start, (begin, end) in zip(starts, pairwise((*self.begins, rows)), strict=True):
            x[begin] = start
            if end - begin > 1:
                part = slice(begin, end - 1)
                arguments = self._arguments(inputs[part], eta[part], part)
                (states,) = self._step_after_step.map(start, *arguments)
                x[begin + 1 : end] = states[self._steps - 1 :: self._steps, :, 0]
        if not np.all(np.abs(x) < DIVERGED * (self._scales + np.max(np.abs(starts), axis=0))):
            return None
        true, y = (
            _by_column(self._output.map(x, self.run.inputs, sizes, self.run.time_min)[0])[:, :, 0]
            for sizes in (np.tile(self._neutral, (rows, 1)), self._neutral + deviation.sample_value)
        )
        return Simulated(x, true, y - true, inputs, deviation) if np.all(np.isfinite(y)) else None

    def _arguments(self, inputs: Array, eta: Array, part: slice) -> tuple[Array, ...]:
        """Inputs, sizes, times and lengths of all steps of an integration."""
        n, h = self._steps, self._interval[part] / self._steps
        times = (self.run.time_min[:-1][part][:, None] + h[:, None] * np.arange(n)).ravel()
        return np.repeat(inputs, n, axis=0), np.repeat(eta, n, axis=0), times, np.repeat(h, n)

    def slopes(self, simulated: Simulated) -> Slopes:
        """Derivatives along a simulation."""
        rows, n = self.run.time_min.size, self._steps
        eta = self._neutral + simulated.deviation.interval_mean[:-1]
        arguments = self._arguments(simulated.inputs, eta, slice(None))
        x, all_rows = simulated.x[:-1], [item.reshape(rows - 1, n, *item.shape[1:]) for item in arguments]
        result: tuple[Array, ...] = ()
        for step in range(n):
            of_step = [item[:, step] for item in all_rows]
            a, b, g = map(_by_column, self._step_slopes.map(x, *of_step))
            result = (a @ result[0], a @ result[1] + b, a @ result[2] + g) if result else (a, b, g)
            if step < n - 1:
                x = self._step.map(x, *of_step)[0][:, :, 0]
        sizes = self._neutral + simulated.deviation.sample_value
        shown = self._output_slopes.map(simulated.x, self.run.inputs, sizes, self.run.time_min)
        return Slopes(*result, *map(_by_column, shown))

    def propagate(self, slopes: Slopes, starts: Array, forcing: "Forcing") -> Array:
        """Derivatives of the true outputs at the kept rows, shape (kept rows, n_y, n).

        Args:
            slopes: derivatives along the simulation.
            starts: derivatives of the states at the first row of each part, shape (parts, n_x, n).
            forcing: what acts on the states between rows.
        """
        n, rows, begins = starts.shape[-1], self.run.time_min.size, {row: i for i, row in enumerate(self.begins)}
        result, number, spacing = np.empty((self.rows.size, slopes.c.shape[1], n)), 0, int(self.rows[1] - self.rows[0])
        state = starts[0]
        for row in range(rows):
            if row in begins:
                state = starts[begins[row]]
            if row % spacing == 0:
                result[number] = slopes.c[row] @ state
                number += 1
            if row < rows - 1:
                state = slopes.a[row] @ state + forcing.on_states(slopes, row)
        return result

    def drive(self, delays: Array, lags: Array) -> Array:
        """Mean inputs from each row to the next, each behind its delay and lag in minutes, shape (rows - 1, n_u)."""
        times, result = self.run.time_min, self.run.inputs[:-1].copy()
        for j, (delay, lag) in enumerate(zip(delays.tolist(), lags.tolist(), strict=True)):
            if delay:
                sums = np.append(0.0, np.cumsum(result[:, j] * self._interval))
                first, last = result[0, j], self.run.inputs[-1, j]
                at = times - delay
                inside = np.interp(at, times, sums)
                total = inside + first * np.minimum(at - times[0], 0.0) + last * np.maximum(at - times[-1], 0.0)
                result[:, j] = np.diff(total) / self._interval
            if lag > 0.0:
                result[:, j] = self._lag_mean(result[:, j], lag)
        return result

    def _lag_mean(self, held: Array, lag: float) -> Array:
        """Mean of a first-order lag's output over each interval, of an input that is held over each."""
        h = self.run.period_min
        kept = float(np.exp(-h / lag))
        after = filter_first_order(held, 1.0 - kept, 0.0, kept, kept * held[0])
        before = np.append(held[0], after[:-1])
        return np.asarray(held + (before - held) * lag / h * (1.0 - kept))

    def read(self, y: Array, delays: Array, lags: Array, period_min: float) -> Array:
        """Readings of outputs, or of derivatives, each behind its delay and lag; shape as `y`, (rows, n_y, ...)."""
        if not (np.any(delays) or np.any(lags)):
            return y
        result = y.copy()
        for j, (delay, lag) in enumerate(zip((delays / period_min).tolist(), lags.tolist(), strict=True)):
            if delay:
                at = np.clip(np.arange(len(y)) - delay, 0.0, len(y) - 1)
                low = np.minimum(at.astype(np.intp), len(y) - 2)
                share = (at - low).reshape(-1, *(1,) * (y.ndim - 2))
                result[:, j] = y[low, j] * (1.0 - share) + y[low + 1, j] * share
            if lag > 0.0:
                kept = float(np.exp(-period_min / lag))
                rest = lag / period_min * (1.0 - kept)
                late, start = result[:, j], rest * result[:1, j]
                result[:, j] = filter_first_order(late, 1.0 - rest, rest - kept, kept, start)
        return result


class Forcing:
    """Deviations that act on the states between rows and on the sensors, in columns.

    Args:
        states: shape (rows - 1, n_x, n).
        sensors: shape (rows, n_y, n).
    """

    def __init__(self, states: Array, sensors: Array) -> None:
        self._states, self._sensors = states, sensors

    def on_states(self, slopes: Slopes, row: int) -> Array:
        """Shape (n_x, n)."""
        return np.asarray(self._states[row])

    def on_sensors(self, slopes: Slopes, rows: NDArray[np.intp]) -> Array:
        """Shape (some rows, n_y, n)."""
        return np.asarray(self._sensors[rows])


class ProductForcing(Forcing):
    """Every effect in every one of some courses in time; the columns are ordered by effect, then by course."""

    def __init__(self, courses: Signal) -> None:
        self._courses = courses

    def on_states(self, slopes: Slopes, row: int) -> Array:
        """See `Forcing`."""
        products = slopes.b[row][:, :, None] * self._courses.interval_mean[row]
        return np.asarray(products.reshape(len(products), -1))

    def on_sensors(self, slopes: Slopes, rows: NDArray[np.intp]) -> Array:
        """See `Forcing`."""
        products = slopes.d[rows][..., None] * self._courses.sample_value[rows][:, None, None, :]
        return np.asarray(products.reshape(rows.size, slopes.d.shape[1], -1))


def _by_column(values: Array) -> Array:
    """The same values, shape (rows, n, ...), those of a column side by side in memory, as they are summed."""
    return np.ascontiguousarray(values.swapaxes(0, 1)).swapaxes(0, 1)

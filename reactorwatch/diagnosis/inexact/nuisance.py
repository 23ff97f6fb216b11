"""Nuisance: what differs a little between any plant and its model, whatever the cause.

| nuisance | prior, normal about 0 |
|---|---|
| initial state of each part of the record | sd 3 scales of the state |
| every effect of the catalogue, from the first row | sd kappa times its typical size; an uncertain parameter's own sd |
| delay of each input and output; of an output negative: measured after its stamp | sd lambda rows, at least 0.1 min |
| first-order lag of each input and output | sd 3 lambda times a row, at least 0.1 min; not negative |
| time of each move of an input inside its interval | sd 0.29 of the interval (uniform), if any |

The widths kappa and lambda, and whether moves are uncertain, are compared like hypotheses (`Prior`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.diagnosis.inexact.simulation import Forcing, InexactSimulation, Simulated, Slopes
from reactorwatch.diagnosis.run import Run
from reactorwatch.process.effect import Effect, ParameterEffect, ParameterShift

SHORTEST_MIN = 0.1
"""Clocks of a plant's devices differ by seconds, however fast it is sampled."""

LAG_SHARE = 3.0
"""Width of a lag's prior over that of a delay's: three rows of a usual sensor."""

MOST_MOVES = 120
"""Moves of inputs beyond which their times are taken as exact: each is a parameter of every fit."""

EXACT = 1e-3
"""Width of what a prior holds at 0, as a share of the usual one: narrower ones only cost digits."""


class Prior(NamedTuple):
    """Widths of the nuisance's priors: see the module."""

    kappa: float
    lam: float
    moves: bool


PRIORS = tuple(Prior(*item) for item in product((0.003, 0.1, 0.3, 1.0), (0.003, 1.0), (False, True)))
"""Priors that are compared."""


def time_sd_min(run: Run, *, is_lag: bool = False) -> float:
    """Standard deviation of the prior of a delay or a lag, for lambda 1."""
    return (LAG_SHARE if is_lag else 1.0) * max(SHORTEST_MIN, run.period_min)


@dataclass(frozen=True, eq=False)
class Linearised:
    """A simulation with nuisance and its derivatives.

    Attributes:
        read: readings at all rows, shape (rows, n_y).
        derivatives: derivatives of the readings at the kept rows by all nuisance, then by the parameters of a cause,
            shape (kept rows, n_y, n).
        slopes: derivatives along the simulation.
    """

    read: Array
    derivatives: Array
    slopes: Slopes


class Nuisance:
    """Layout of the nuisance of a simulation, as one vector, its priors and its derivatives.

    Args:
        simulation: the simulation.
        starts: usual states at the first row of each part, shape (parts, n_x).
        stated: standard deviations of parameters that the user states, in their units; 0: exact.

    Attributes:
        names: name of each: an effect's, `<signal>.delay`, `<signal>.lag`, `<state>.start`, `<input>.move`.
    """

    def __init__(self, simulation: InexactSimulation, starts: Array, stated: Mapping[str, float]) -> None:
        self.simulation, self._usual_starts, self._stated = simulation, starts, stated
        model = simulation.model
        n_x, n_u, n_y = len(model.states), len(model.inputs), len(model.outputs)
        self._moves = self._find_moves()
        counts = (n_x * len(starts), len(simulation.effects), n_u, n_u, n_y, n_y, len(self._moves))
        ends = np.cumsum(counts).tolist()
        begins = [0, *ends[:-1]]
        slices = [slice(*item) for item in zip(begins, ends, strict=True)]
        self.starts, self.effects, self.input_delays, self.input_lags = slices[:4]
        self.output_delays, self.output_lags, self.moves = slices[4:]
        self.size = ends[-1]
        inputs, outputs = model.input_names, model.output_names
        self.names = (
            *(f"{name}.start" for _ in starts for name in model.state_names),
            *(effect.name for effect in simulation.effects),
            *(f"{name}.delay" for name in inputs),
            *(f"{name}.lag" for name in inputs),
            *(f"{name}.delay" for name in outputs),
            *(f"{name}.lag" for name in outputs),
            *(f"{inputs[j]}.move" for _, j in self._moves),
        )
        self.lower = np.full(self.size, -np.inf)
        self.lower[self.input_lags] = self.lower[self.output_lags] = 0.0
        self.upper = np.full(self.size, np.inf)
        self.lower[self.effects] = [effect.lower - effect.neutral for effect in simulation.effects]
        self.upper[self.effects] = [effect.upper - effect.neutral for effect in simulation.effects]

    def _find_moves(self) -> list[tuple[int, int]]:
        """(row, input) of each move of an input, if they are few."""
        inputs = self.simulation.run.inputs
        moves = [(int(row) + 1, j) for j in range(inputs.shape[1]) for row in np.flatnonzero(np.diff(inputs[:, j]))]
        return moves if len(moves) <= MOST_MOVES else []

    @cached_property
    def priors(self) -> tuple[Prior, ...]:
        """Priors that differ for this run."""
        return PRIORS if self._moves else tuple(item for item in PRIORS if not item.moves)

    @property
    def lag_start_min(self) -> float:
        """Lag from which a fit may start: that of a slow sensor."""
        return 2.0 * time_sd_min(self.simulation.run)

    def sds(self, prior: Prior) -> Array:
        """Standard deviation of each nuisance's prior, shape (size,)."""
        model, result = self.simulation.model, np.empty(self.size)
        result[self.starts] = np.tile([3.0 * state.scale for state in model.states], len(self._usual_starts))
        typical = prior.kappa * self.simulation.typical
        result[self.effects] = [
            sd if (stated := self._stated_sd(effect)) is None else max(stated, EXACT * abs(effect.typical))
            for effect, sd in zip(self.simulation.effects, typical.tolist(), strict=True)
        ]
        run = self.simulation.run
        result[self.input_delays] = result[self.output_delays] = prior.lam * time_sd_min(run)
        result[self.input_lags] = result[self.output_lags] = prior.lam * time_sd_min(run, is_lag=True)
        result[self.moves] = 12.0**-0.5 if prior.moves else EXACT
        return result

    def _stated_sd(self, effect: Effect) -> float | None:
        """Standard deviation of an effect on a parameter for which the user states one."""
        if not isinstance(effect, (ParameterEffect, ParameterShift)) or effect.parameter not in self._stated:
            return None
        scale = abs(self.simulation.model.parameter(effect.parameter).value) if effect.unit == "1" else 1.0
        return self._stated[effect.parameter] / scale if scale else None

    def simulate(self, theta: Array, deviation: Signal | None = None) -> Simulated | None:
        """Simulate with nuisance and further deviations of the effects; None if it diverges."""
        constant = np.tile(theta[self.effects], (self.simulation.run.time_min.size, 1))
        both = Signal(constant, constant)
        if deviation is not None:
            both = Signal(constant + deviation.interval_mean, constant + deviation.sample_value)
        starts = self._usual_starts + theta[self.starts].reshape(self._usual_starts.shape)
        inputs = self.simulation.drive(theta[self.input_delays], theta[self.input_lags])
        return self.simulation.simulate(starts, inputs, both)

    def read(self, simulated: Simulated, theta: Array) -> Array:
        """Readings at all rows: the true outputs behind delays and lags, and the sensors' errors; shape (rows, n_y)."""
        delays, lags, period = theta[self.output_delays], theta[self.output_lags], self.simulation.run.period_min
        return np.asarray(self.simulation.read(simulated.true, delays, lags, period) + simulated.errors)

    def derivatives(self, theta: Array, slopes: Slopes, starts: Array, forcing: Forcing) -> Array:
        """Derivatives of the readings at the kept rows, arguments as for `propagate`."""
        sim, delays, lags = self.simulation, theta[self.output_delays], theta[self.output_lags]
        period = sim.run.period_min * float(sim.rows[1] - sim.rows[0])
        return sim.read(sim.propagate(slopes, starts, forcing), delays, lags, period) + forcing.on_sensors(
            slopes, sim.rows
        )

    def linearise(self, theta: Array, simulated: Simulated, cause: int = 0, course: Signal | None = None) -> Linearised:
        """Readings of a simulation, and their derivatives by all nuisance and by the parameters of a cause.

        Args:
            theta: nuisance of the simulation.
            simulated: the simulation.
            cause: index of the effect that is the cause.
            course: derivatives of its deviation by each of its parameters, shape (rows, parameters); None: no cause.
        """
        sim, rows = self.simulation, self.simulation.run.time_min.size
        slopes = sim.slopes(simulated)
        n_x, n_states, n = len(sim.model.states), self.starts.stop, self.size
        n += 0 if course is None else course.sample_value.shape[1]
        states, outputs = np.zeros((rows - 1, n_x, n)), np.zeros((rows, slopes.c.shape[1], n))
        states[:, :, self.effects], outputs[:, :, self.effects] = slopes.b, slopes.d
        if course is not None:
            states[:, :, self.size :] = slopes.b[:, :, cause, None] * course.interval_mean[:-1, None]
            outputs[:, :, self.size :] = slopes.d[:, :, cause, None] * course.sample_value[:, None]
        driven = self._input_derivatives(theta)
        states[:, :, self.input_delays.start : self.input_lags.stop] = slopes.g[:, :, driven[1]] * driven[0][:, None]
        for number, (row, j) in enumerate(self._moves, start=self.moves.start):
            if row < rows - 1:  # a share of the interval later
                states[row, :, number] = -slopes.g[row, :, j] * (
                    simulated.inputs[row, j] - simulated.inputs[row - 1, j]
                )
        starts = np.zeros((len(self._usual_starts), n_x, n))
        starts[..., :n_states] = np.eye(n_states).reshape(-1, n_x, n_states)
        found = self.derivatives(theta, slopes, starts, Forcing(states, outputs))
        read = self.read(simulated, theta)
        self._add_sensors(theta, simulated, read, found)
        return Linearised(read, found, slopes)

    def _input_derivatives(self, theta: Array) -> tuple[Array, list[int]]:
        """Derivatives of the inputs by their delays, then lags, shape (rows - 1, 2 n_u); and the input of each."""
        sim, n_u = self.simulation, len(self.simulation.model.inputs)
        delays, lags, step = theta[self.input_delays], theta[self.input_lags], 0.1 * sim.run.period_min
        base, columns = sim.drive(delays, lags), []
        for j in range(n_u):
            moved = np.where(np.arange(n_u) == j, step, 0.0)
            ahead, behind = sim.drive(delays + moved, lags), sim.drive(delays - moved, lags)
            columns += [(ahead - behind)[:, j] / (2.0 * step)]
        for j in range(n_u):
            moved = np.where(np.arange(n_u) == j, step, 0.0)
            columns += [(sim.drive(delays, lags + moved) - base)[:, j] / step]
        return np.column_stack(columns), [*range(n_u), *range(n_u)]

    def _add_sensors(self, theta: Array, simulated: Simulated, read: Array, result: Array) -> None:
        """Add the derivatives by the delays and lags of the sensors."""
        step, rows = 0.1 * self.simulation.run.period_min, self.simulation.rows
        for first in (self.output_delays.start, self.output_lags.start):
            for j in range(read.shape[1]):
                moved = theta.copy()
                moved[first + j] += step
                result[:, j, first + j] = ((self.read(simulated, moved) - read)[:, j] / step)[rows]

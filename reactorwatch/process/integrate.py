"""Runge-Kutta step, and the grid of steps on which its error stays small.

The method is the pair of Cash & Karp (1990), A variable order Runge-Kutta method for initial value problems with
rapidly varying right-hand sides, ACM Trans. Math. Softw. 16(3), orders 5 and 4: six evaluations a step, error estimate
included. On the operating branch a fixed step of 0.05 min is inside the tolerance, and a record of thousands of rows
runs as one piece of machine code. (The pair of Dormand & Prince takes seven evaluations, the last of which would only
save one if the input did not jump, and at this step has twice the error.) Where the estimate exceeds the tolerance (an
upset, an ignition: the reaction then has time constants below a second) the interval is integrated with adaptive steps.

A step never crosses a sample, where the input jumps, nor a breakpoint of the model.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from math import isfinite

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.array_function import ArrayFunction
from reactorwatch.process.effect_states import reset_function
from reactorwatch.process.model import MODEL_CACHE_SIZE, ProcessModel

LONGEST_STEP_MIN = 0.05
SHORTEST_STEP_MIN = 1e-9
MAX_STEPS = 100_000
"""Largest number of steps between two samples: some half a second. Beyond it the equations count as too stiff."""

TOLERANCE = 1e-6
"""Allowed local error of a step, relative to `Variable.scale` of each state."""

MEMORY_SLACK = 100
"""Tolerance of the states that effects add (`ProcessModel.at_rest`) over that of the process's own states. These are
linear and stable, so errors do not grow, and after a jump of an input they respond as fast as a step is long."""

_TIMES = (0.0, 1 / 5, 3 / 10, 3 / 5, 1.0, 7 / 8)
_STAGES: tuple[tuple[float, ...], ...] = (
    (),
    (1 / 5,),
    (3 / 40, 9 / 40),
    (3 / 10, -9 / 10, 6 / 5),
    (-11 / 54, 5 / 2, -70 / 27, 35 / 27),
    (1631 / 55296, 175 / 512, 575 / 13824, 44275 / 110592, 253 / 4096),
)
_FIFTH_ORDER = (37 / 378, 0.0, 250 / 621, 125 / 594, 0.0, 512 / 1771)
_FOURTH_ORDER = (2825 / 27648, 0.0, 18575 / 48384, 13525 / 55296, 277 / 14336, 1 / 4)
_ERROR = tuple(fifth - fourth for fifth, fourth in zip(_FIFTH_ORDER, _FOURTH_ORDER, strict=True))


class SimulationError(ValueError):
    """The equations cannot be integrated further; the text says where."""


def state_time_step(model: ProcessModel, u: ca.SX, p: ca.SX, t: ca.SX, middle: ca.SX, h: ca.SX) -> ca.SX:
    """Time step of the states in a step of the clock from t to t + h; see `ProcessModel.time_offset`."""
    clock = model.clock
    if not ca.depends_on(model.time_offset, ca.vertcat(clock.now, clock.middle)):
        return h
    _, inputs, parameters = model.arguments()
    ahead = ca.Function("ahead", [inputs, parameters, clock.now, clock.middle], [model.time_offset])
    return h - (ahead(u, p, t + h, middle) - ahead(u, p, t, middle))


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def symbolic_step(model: ProcessModel) -> ca.Function:
    """One step as a CasADi function (x, u, p, t, t_middle, h) -> (x at t + h, error estimate over scale).

    The error estimate is the largest over the states, a scalar.
    """
    rhs = model.function("rhs")
    x, u, p = model.arguments()
    t, middle, h = ca.SX.sym("t"), ca.SX.sym("t_middle"), ca.SX.sym("h")
    passed, slopes = state_time_step(model, u, p, t, middle, h), list[ca.SX]()
    for time, weights in zip(_TIMES, _STAGES, strict=True):
        slopes.append(rhs(x + passed * _weighted_sum(weights, slopes), u, p, t + time * h, middle)[0])
    after = x + passed * _weighted_sum(_FIFTH_ORDER, slopes)
    error = passed * _weighted_sum(_ERROR, slopes)
    scales = ca.DM([state.scale * (MEMORY_SLACK if state.name in model.at_rest else 1) for state in model.states])
    return ca.Function(
        "step",
        [x, u, p, t, middle, h],
        [after, ca.mmax(ca.fabs(error / scales))],
        ["x", "u", "p", "t", "t_middle", "h"],
        ["x_next", "error"],
    )


def _weighted_sum(weights: tuple[float, ...], slopes: list[ca.SX]) -> ca.SX:
    terms = (weight * slope for weight, slope in zip(weights, slopes, strict=True) if weight)
    return sum(terms, ca.SX(0))


@dataclass(frozen=True, eq=False)
class StepGrid:
    """Consecutive integration steps of a run, which end at every sample and every breakpoint.

    Attributes:
        start_min: start of each step, shape (steps,).
        length_min: length of each step, shape (steps,).
        middle_min: middle of the interval without a jump that contains the step, shape (steps,).
        row: row of the record whose input holds, shape (steps,).
        origin: breakpoint at the start of that interval, shape (steps,); -1: none.
        target: breakpoint at its end, shape (steps,); -1: none.
        share_before: share of the interval before the step, in [0, 1), shape (steps,).
        share: share of the interval that the step covers, in (0, 1], shape (steps,).
        end_of_row: index of the step that ends at the following row, shape (rows - 1,).
    """

    start_min: Array
    length_min: Array
    middle_min: Array
    row: NDArray[np.int64]
    origin: NDArray[np.int64]
    target: NDArray[np.int64]
    share_before: Array
    share: Array
    end_of_row: NDArray[np.int64]

    def refine(self, cuts: Mapping[int, Array]) -> "StepGrid":
        """Cut some steps.

        Args:
            cuts: lengths of the parts of a step, by index of the step.
        """
        counts = np.ones(self.length_min.size, dtype=np.int64)
        counts[list(cuts)] = [lengths.size for lengths in cuts.values()]
        parts = np.repeat(np.arange(counts.size), counts)
        length = self.length_min[parts]
        ends = np.cumsum(counts)
        for step, lengths in cuts.items():
            length[ends[step] - lengths.size : ends[step]] = lengths
        total = np.cumsum(length)
        before = total - length - np.concatenate(([0.0], total[ends[:-1] - 1]))[parts]
        uncut = np.where(self.length_min > 0, self.length_min, 1.0)[parts]  # a step of zero length is not cut
        fraction = np.where(counts[parts] > 1, length / uncut, 1.0)
        fraction_before = before / uncut
        return StepGrid(
            start_min=self.start_min[parts] + before,
            length_min=length,
            middle_min=self.middle_min[parts],
            row=self.row[parts],
            origin=self.origin[parts],
            target=self.target[parts],
            share_before=self.share_before[parts] + fraction_before * self.share[parts],
            share=fraction * self.share[parts],
            end_of_row=ends[self.end_of_row] - 1,
        )


def step_grid(time_min: Array, breakpoints: Array, longest_min: float = LONGEST_STEP_MIN) -> StepGrid:
    """Make steps that end at every sample and every breakpoint.

    A breakpoint on a sample opens an interval of zero length before it: derivatives with respect to it are those
    towards later times. Of coinciding breakpoints, the last gets the derivative of all.

    Args:
        time_min: shape (rows,), increasing.
        breakpoints: shape (n,), times in minutes; those outside the record have no effect.
        longest_min: the longest step.
    """
    inside = np.flatnonzero((breakpoints >= time_min[0]) & (breakpoints < time_min[-1]))
    edges = np.concatenate([time_min, breakpoints[inside]])
    marks = np.concatenate([np.full(time_min.size, -1), inside])
    order = np.argsort(edges, kind="stable")
    edges, marks = edges[order], marks[order]
    interval = np.diff(edges)
    middle = np.minimum(0.5 * (edges[:-1] + edges[1:]), np.nextafter(edges[1:], -np.inf))  # before the jump at its end
    counts = np.maximum(np.ceil(interval / longest_min - 1e-9).astype(np.int64), 1)
    part = np.repeat(np.arange(interval.size), counts)
    position = np.arange(part.size) - np.repeat(np.cumsum(counts) - counts, counts)
    share = 1.0 / counts[part]
    row = np.searchsorted(time_min, edges[:-1], side="right") - 1
    ends = np.cumsum(counts) - 1
    return StepGrid(
        start_min=edges[part] + position * share * interval[part],
        length_min=share * interval[part],
        middle_min=middle[part],
        row=row[part],
        origin=marks[part],
        target=marks[part + 1],
        share_before=position * share,
        share=share,
        end_of_row=ends[np.searchsorted(edges[1:], time_min[1:], side="left")],
    )


class Stepper:
    """Integrates a model with adaptive steps.

    Args:
        model: the process.
    """

    def __init__(self, model: ProcessModel) -> None:
        self._model = model
        self._step = ArrayFunction(symbolic_step(model))
        self._breakpoints = [model.parameter_names.index(name) for name in model.breakpoints]
        self._reset = ArrayFunction(reset_function(model)) if model.resets else None

    def start_row(self, x: Array, u: Array, p: Array, time_min: float) -> Array:
        """State after the jumps (`ProcessModel.resets`) at a row.

        Args:
            x: state before, shape (n_x,).
            u: input from then on, shape (n_u,).
            p: parameters, shape (n_p,).
            time_min: time of the row.
        """
        if self._reset is None:
            return x
        after: Array = self._reset.call(x, u, p, time_min)[0][0]
        return after

    def advance(self, x: Array, u: Array, p: Array, start_min: float, end_min: float) -> Array:
        """State at the end of an interval over which the input is constant.

        Args:
            x: state at the start, shape (n_x,).
            u: input, shape (n_u,).
            p: parameters, shape (n_p,).
            start_min: start of the interval, plant time.
            end_min: end of the interval.

        Raises:
            SimulationError: the equations cannot be integrated further.
        """
        jumps = sorted({float(p[i]) for i in self._breakpoints if start_min < p[i] < end_min})
        edges = [start_min, *jumps, end_min]
        for left, right in pairwise(edges):
            x, _ = self.integrate(x, u, p, left, right - left, 0.5 * (left + right))
        return x

    def integrate(
        self, x: Array, u: Array, p: Array, start_min: float, length_min: float, middle_min: float
    ) -> tuple[Array, Array]:
        """Integrate over an interval without a jump; returns the state at its end and the lengths of the steps.

        Raises:
            SimulationError: no step, however short, keeps the tolerance, or too many are needed.
        """
        state, inputs, parameters, time, middle, length = (argument[0] for argument in self._step.arguments)
        after, estimate = (result[0] for result in self._step.results)
        state[:], inputs[:], parameters[:], middle[0] = x, u, p, middle_min
        done, step = 0.0, min(length_min, LONGEST_STEP_MIN)
        lengths: list[float] = []
        while done < length_min:
            step = min(step, length_min - done)
            if length_min - done - step < 1e-12 * length_min:
                step = length_min - done
            time[0], length[0] = start_min + done, step
            self._step()
            error = estimate.item() / TOLERANCE
            good = isfinite(error) and bool(np.isfinite(after).all())
            if good and error <= 1.0:
                done += step
                lengths.append(step)
                state[:] = after
                step = min(LONGEST_STEP_MIN, step * min(5.0, 0.9 * max(error, 1e-10) ** -0.2))
                stuck = len(lengths) > MAX_STEPS
            else:
                step *= max(0.1, 0.9 * error**-0.2) if good else 0.1
                stuck = step < SHORTEST_STEP_MIN
            if stuck:
                where = zip(self._model.states, state.tolist(), strict=True)
                values = ", ".join(f"{item.name} = {value:g} {item.unit}" for item, value in where)
                raise SimulationError(
                    f"{self._model.name} cannot be integrated beyond {start_min + done:g} min, where {values}"
                )
        return state.copy(), np.array(lengths)

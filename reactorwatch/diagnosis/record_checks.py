"""Convert a record to a run of a model, and check that it can be diagnosed.

A signal cannot have some values: placeholders for "not measured", such as -999, 9999 or 65535. A filter would take such
a value for the plant. An input beyond its bounds cannot be simulated; an output may exceed the bounds of its state by a
scale, for noise and offset of its sensor.

Check the units of a record against those of the model, for every command that reads a record. With its inputs at their
median, a plant is within a few scales of one of the model's steady states, whatever its faults. If the record is
further off, and would be near one with one of its signals multiplied by a unit conversion, the unit is wrong, and also
if a median is out of the signal's bounds. If the rows are so far apart that the process has forgotten each before the
next, or the record ends before the process has moved, its times have another unit, or it carries no information.

A usual excitation of any process, where no record shows one. Every input steps at random between levels around its
usual value (`Variable.usual`; the middle of its bounds where that is unknown), `STEP_ROWS` rows each, from the stable
steady state there. A row is a tenth of the time constant with which that state is reached, so every process moves at
its own speed.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.run import Run
from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.process.effect import Effect
from reactorwatch.process.generic import needs_moves, output_scales, reference_point
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import SteadyState, SteadyStates, steady_states
from reactorwatch.records.record import Record

MARGIN = 1.0
"""Threshold in scales of a state: its sensor may exceed the bounds by this."""


class Bounds(NamedTuple):
    """Lowest and highest possible value of a signal, in its unit."""

    lower: float
    upper: float
    unit: str


def bounds_of(model: ProcessModel) -> dict[str, Bounds]:
    """Bounds of the inputs, and of the outputs that are states, by name."""
    margins = {state.name: (state, MARGIN * state.scale) for state in model.states if state.name in model.output_names}
    margins |= {item.name: (item, 0.0) for item in model.inputs}
    return {
        name: Bounds(item.lower - margin, item.upper + margin, item.unit) for name, (item, margin) in margins.items()
    }


def check_values(record: Record, model: ProcessModel) -> None:
    """Check that a record has no impossible values; missing columns are skipped.

    Raises:
        InputError: the first such value, by file, row and column.
    """
    for name, bounds in bounds_of(model).items():
        if name in record.columns:
            _check_column(record, name, bounds)


def _check_column(record: Record, name: str, bounds: Bounds) -> None:
    values, (lower, upper, unit) = record.columns[name], bounds
    rows = np.flatnonzero(np.isfinite(values) & ~((values >= lower) & (values <= upper)))
    if not rows.size:
        return
    row = int(rows[0])
    others = np.count_nonzero(values[rows] == values[row]) - 1
    also = f" (and {others} more of it)" if others else ""
    read_as = f"; read as: {record.read_as}" if "--missing" in record.read_as else ""  # a code, in the file's unit
    raise InputError(
        f"{_place(record, row)}, column {name!r}: must be in [{lower:g}, {upper:g}] {unit}, "
        f"got {values[row]:g}{also}; empty the cells that mean 'not measured'{read_as}"
    )


def _place(record: Record, row: int) -> str:
    at = f"{record.time_min[row]:g} min"
    if record.first_row is None:  # of a recording
        return f"{record.name}, at {at}"
    return f"{record.name}, row {record.first_row + row} ({at})"


FACTORS = (60.0, 1000.0, 3600.0, 1000.0 / 60.0, 3.6, 1e6, 100.0)
"""Unit conversions of time, amounts, flows (m3/h and l/min) and fractions, in either direction."""

FAR, NEAR = 3.0, 0.7
"""Distances in scales of a state: no effect of the catalogue moves a plant beyond the first; a plant within the second
is at the steady state."""

FORGOTTEN, MOVED = 5.0, 6.0
"""Maximum row distance in slowest time constants, and minimum record length in fastest ones."""


class WrongUnit(NamedTuple):
    """A signal, or the times of a record, in another unit than the model's.

    Attributes:
        text: the rule, the value and the cure.
        of_times: true if the times are in another unit.
    """

    text: str
    of_times: bool = False


def find_wrong_unit(model: ProcessModel, columns: Mapping[str, Array], time_min: Array) -> WrongUnit | None:
    """Find the first unit of a record that is not the model's; None if there is none, or a signal is missing.

    Args:
        model: process model of the plant.
        columns: values by signal, NaN where not measured; they may differ in length.
        time_min: shape (rows,).
    """
    own = model.without_effect_states
    typical = _typical_values(own, columns)
    if typical is None or time_min.size < 2:
        return None
    u = np.array([typical[name] for name in own.input_names])
    y = np.array([typical[name] for name in own.output_names])
    when, rests, scales = float(np.median(time_min)), _steady_states(own), _scales(own)
    points = rests.at(u, when) if _possible(own, u) else []
    if points:
        nearest = min(points, key=lambda point: _distance(point, y, scales))
        if _distance(nearest, y, scales) < FAR:
            return _out_of_bounds(own, typical) or _find_wrong_time_unit(time_min, nearest)
    for index, item in enumerate(own.inputs):
        for factor in (*FACTORS, *(1.0 / factor for factor in FACTORS)):
            changed = u.copy()
            changed[index] = factor * float(u[index])
            if _possible(own, changed) and any(_distance(point, y, scales) < NEAR for point in rests.at(changed, when)):
                return WrongUnit(_describe(item.name, item.unit, float(u[index]), f"times {factor:.4g}"))
    for index, output in enumerate(own.outputs):
        for value, hint in _in_other_units(float(y[index]), output.unit):
            changed = y.copy()
            changed[index] = value
            if any(_distance(point, changed, scales) < NEAR for point in points):
                return WrongUnit(_describe(output.name, output.unit, float(y[index]), hint))
    return _out_of_bounds(own, typical)


@lru_cache(maxsize=2)
def _steady_states(model: ProcessModel) -> SteadyStates:
    """Steady states, compiled once for many records of a plant."""
    return SteadyStates(model)


def _typical_values(model: ProcessModel, columns: Mapping[str, Array]) -> dict[str, float] | None:
    """Median of each signal, without impossible values if these are few distinct ones, such as -999."""
    bounds, result = bounds_of(model), {}
    for name in (*model.input_names, *model.output_names):
        values = columns.get(name, np.empty(0))
        values = values[np.isfinite(values)]
        if not values.size:
            return None
        if name in bounds:
            possible = values[(values >= bounds[name].lower) & (values <= bounds[name].upper)]
            if 2 * np.unique(possible).size > np.unique(values).size:
                values = possible
        result[name] = float(np.median(values))
    return result


def _possible(model: ProcessModel, u: Array) -> bool:
    return all(item.lower <= value <= item.upper for item, value in zip(model.inputs, u.tolist(), strict=True))


def _out_of_bounds(model: ProcessModel, typical: Mapping[str, float]) -> WrongUnit | None:
    """First signal whose median is out of the input's or state's bounds."""
    for name, item in {item.name: item for item in (*model.inputs, *model.states)}.items():
        if name not in typical or item.lower <= typical[name] <= item.upper:
            continue
        celsius = item.unit == "K" and item.lower <= typical[name] + 273.15 <= item.upper
        hint = "is it in degrees C? then add 273.15" if celsius else "check its unit"
        rule = f"{name} must be in [{item.lower:g}, {item.upper:g}] {item.unit}"
        return WrongUnit(f"{rule}, its median is {typical[name]:g}; {hint}")
    return None


def _find_wrong_time_unit(time_min: Array, point: SteadyState) -> WrongUnit | None:
    rates = np.abs(point.eigenvalues)
    period, slowest, fastest = float(np.median(np.diff(time_min))), 1.0 / rates.min(), 1.0 / rates.max()
    span = float(time_min[-1] - time_min[0])
    cure = "check the unit of the times, which is that of the column's name, time_min or time_s"
    if period > FORGOTTEN * slowest:
        return WrongUnit(
            f"rows must be closer than {FORGOTTEN * slowest:.3g} min, they are {period:.3g} min apart, and in "
            f"between the process forgets all; {cure}, or sample faster",
            of_times=True,
        )
    if span < MOVED * fastest:
        return WrongUnit(
            f"must last at least {MOVED * fastest:.3g} min for the process to move, it lasts {span:.3g} min; {cure}, "
            "or record for longer",
            of_times=True,
        )
    return None


def _scales(model: ProcessModel) -> Array:
    """Scales of the outputs: those of their states."""
    of_states = {state.name: state.scale for state in model.states}
    return np.array([of_states.get(output.name, np.inf) for output in model.outputs])


def _distance(point: SteadyState, y: Array, scales: Array) -> float:
    with np.errstate(over="ignore", invalid="ignore"):  # y may be any number
        return float(np.max(np.abs(point.outputs - y) / scales))


def _in_other_units(value: float, unit: str) -> list[tuple[float, str]]:
    result = [(factor * value, f"times {factor:.4g}") for item in FACTORS for factor in (item, 1.0 / item)]
    if unit == "K":
        result += [(value + 273.15, "taken as degrees C"), ((value + 459.67) / 1.8, "taken as degrees F")]
    return result


def _describe(signal: str, unit: str, median: float, hint: str) -> str:
    return (
        f"{signal} must be in {unit}; with its median of {median:.4g} the simulation rests nowhere near the "
        f"record, but {hint} it would; check its unit"
    )


FEWEST_ROWS = 200
FEWEST_VALUES = 20
"""Minimum number of values of an output, such as a laboratory's: of fewer the noise is not known to a sixth, as the
relative error of a standard deviation from n values is 1 / sqrt(2 n)."""

LEAST_MOVE = 1e-3
"""Minimum movement of an input, in its scales."""

FEW_ROWS = 10
"""The filter bridges up to this many missing rows, and restarts after more."""

_OFF_GRID, _REGULAR = 0.05, 0.95
"""Tolerance of steps that are whole periods, and the fraction of steps that must be, for rows on a grid."""


def make_run(record: Record, model: ProcessModel) -> Run:
    """Convert a record to a run of the model.

    Missing inputs keep their last value. Times of a record with several runs are `continuous_min`.

    Raises:
        InputError: a process without inputs; too few rows; a signal that is missing, constant or in another unit; an
            impossible value.
    """
    name = record.name
    if not model.inputs:
        raise InputError(
            f"{name}: a diagnosis needs a process with an input, {model.name} has none; causes are distinguished by "
            "what outputs do when inputs move: make what moves the process an input of its equations"
        )
    if record.rows < FEWEST_ROWS:
        raise UnfitRecordError(
            f"{name}: a diagnosis needs at least {FEWEST_ROWS} rows, got {record.rows}; record for longer"
        )
    missing = [item for item in (*model.input_names, *model.output_names) if item not in record.columns]
    if missing:
        raise InputError(
            f"{name}: needs the columns {', '.join((*model.input_names, *model.output_names))}, "
            f"{', '.join(missing)} is not there"
        )
    outputs = []
    for output in model.outputs:
        values = record.columns[output.name]
        finite = values[np.isfinite(values)]
        if finite.size < FEWEST_VALUES:
            raise UnfitRecordError(
                f"{name}: {output.name} needs at least {FEWEST_VALUES} values, got {finite.size}; "
                "is the column the right one, and is the sensor recorded?"
            )
        if np.ptp(finite) == 0.0:
            raise UnfitRecordError(
                f"{name}: {output.name} must vary, it is {finite[0]:g} {output.unit} in every row; "
                "the sensor is stuck, or the column is not what it seems"
            )
        outputs.append(values)
    inputs = []
    for item in model.inputs:
        values = np.concatenate([_hold_last(part.columns[item.name]) for part in record.split_runs()])
        if not np.all(np.isfinite(values)):
            of_run = "the first row" if record.runs is None else "the first row of each run"
            raise UnfitRecordError(
                f"{name}: {item.name} must be there in {of_run}; leave out the rows before its first value"
            )
        inputs.append(values)
    wrong = find_wrong_unit(model, record.columns, record.continuous_min)
    if wrong is not None and not wrong.of_times:
        raise InputError(f"{name}: {wrong.text}")
    check_values(record, model)
    if all(np.ptp(values) <= LEAST_MOVE * item.scale for values, item in zip(inputs, model.inputs, strict=True)):
        raise UnfitRecordError(
            f"{name}: {', '.join(model.input_names)} must move, it is {inputs[0][0]:g} all the time; "
            "causes cannot be distinguished without excitation: record an interval with steps in it"
        )
    if wrong is not None:
        raise InputError(f"{name}: {wrong.text}")
    there: NDArray[np.bool_] = np.column_stack([np.isfinite(record.columns[item.name]) for item in model.inputs])
    u = np.column_stack(inputs)
    time_min, starts = record.continuous_min, record.run_starts[1:]
    breaks, few = _breaks(time_min, u, there)
    return Run(time_min, u, np.column_stack(outputs), tuple(sorted({*breaks, *starts})), few, starts)


def describe_still_inputs(model: ProcessModel, effects: Sequence[Effect], inputs: Array) -> list[str]:
    """Describe which causes cannot be seen, as inputs never moved; empty if all did.

    Args:
        model: the process model.
        effects: the causes.
        inputs: inputs of the record, shape (rows, n_u).
    """
    columns = zip(model.input_names, inputs.T, strict=True)
    held = {name: float(column[0]) for name, column in columns if np.ptp(column) == 0.0}  # NaN is not equal to itself
    hidden = [effect.name for effect in effects if held and needs_moves(model, effect, held)]
    if not hidden:
        return []
    levels = " and ".join(f"{name} ({level:g})" for name, level in held.items())
    return [f"{levels} never moved, so these causes cannot be seen until it does: {', '.join(hidden)}"]


def describe_outliers(whole: Run, run: Run) -> list[str]:
    """Describe how many values were excluded as outliers; empty if none was.

    Args:
        whole: the record.
        run: the record without its outliers.
    """
    count = whole.values - run.values
    if count == 0:
        return []
    values = "1 value was" if count == 1 else f"{count} values were"
    return [f"{values} excluded as outliers"]


def describe_short_record(run: Run, nuisance: int) -> list[str]:
    """Describe that a record has fewer rows than the comparison with nuisance has parameters; empty if it has not."""
    rows = run.time_min.size
    if rows >= nuisance:
        return []
    return [
        f"{rows} rows are few for the {nuisance} parameters of the nuisance, which its priors then decide: "
        f"record at least {nuisance} rows"
    ]


def _breaks(
    time_min: Array, inputs: Array, finite: NDArray[np.bool_]
) -> tuple[tuple[int, ...], NDArray[np.intp] | None]:
    """Rows after too long a gap in which the inputs changed at an unknown time; of the other gaps, `Run.missing`.

    In a record with irregular rows none counts as missing.
    """
    step = np.diff(time_min)
    period = float(np.median(step))
    counts = step / period
    regular = np.mean(np.abs(counts - np.round(counts)) < _OFF_GRID) > _REGULAR
    changed = np.any(np.diff(inputs, axis=0) != 0.0, axis=1)
    missing = np.round(counts).astype(np.intp) - 1
    short = changed & regular & (missing > 0) & (missing <= FEW_ROWS) & np.all(finite[:-1], axis=1)
    long = changed & ((counts > 1.5) & regular | ~np.all(finite[:-1], axis=1)) & ~short
    few = np.append(0, np.where(short, missing, 0))
    return tuple((np.flatnonzero(long) + 1).tolist()), few if np.any(short) else None


def _hold_last(values: Array) -> Array:
    """Replace missing values by the last value before them."""
    places = np.where(np.isfinite(values), np.arange(values.size), -1)
    places = np.maximum.accumulate(places)
    return np.where(places >= 0, values[np.maximum(places, 0)], np.nan)


ROWS, STEP_ROWS, SEED = 2000, 10, 1
"""Rows; rows of each level; seed of the levels and of the noise."""

REACH_SCALES = 0.7
"""Largest distance of a level from the usual value, in scales of the input."""

NOISE_SHARE = 0.02
"""Standard deviation of a sensor's noise, in scales of its output."""

ROWS_A_TIME_CONSTANT = 10.0
SHORTEST_PERIOD_MIN, LONGEST_PERIOD_MIN = 1e-3, 10.0


def excite(model: ProcessModel, resolution: Mapping[str, float] | None = None) -> Record:
    """Record of the process with its usual excitation and noise.

    Args:
        model: process model of the plant.
        resolution: smallest step between two values of an output, by name, in its unit; others are continuous.
    """
    usual = np.array(
        [0.5 * (item.lower + item.upper) if item.usual is None else item.usual for item in model.inputs], dtype=float
    )
    rest = _steady_state(model, usual)
    period_min = LONGEST_PERIOD_MIN
    if rest is not None and len(rest.eigenvalues):
        slowest = float(np.min(np.abs(rest.eigenvalues)))
        period_min = 1.0 / (ROWS_A_TIME_CONSTANT * max(slowest, 1e-9))
    time_min = float(np.clip(period_min, SHORTEST_PERIOD_MIN, LONGEST_PERIOD_MIN)) * np.arange(ROWS, dtype=float)
    rng = np.random.default_rng(SEED)
    levels = rng.uniform(-REACH_SCALES, REACH_SCALES, (ROWS // STEP_ROWS, usual.size))
    scales = np.array([item.scale for item in model.inputs])
    bounds = [(item.lower, item.upper) for item in model.inputs]
    lower, upper = np.array(bounds).reshape(-1, 2).T
    inputs: Array = np.clip(usual + scales * np.repeat(levels, STEP_ROWS, axis=0), lower, upper)
    start = reference_point(model)[0] if rest is None else rest.state
    outputs = Simulator(model).run(time_min, inputs, start[: _own_states(model)]).outputs
    outputs = outputs + NOISE_SHARE * np.array(output_scales(model)) * rng.standard_normal(outputs.shape)
    columns = dict(zip((*model.input_names, *model.output_names), np.hstack([inputs, outputs]).T, strict=True))
    for name, step in (resolution or {}).items():
        columns[name] = step * np.round(columns[name] / step)
    return Record(time_min, columns, f"usual excitation of {model.name}")


def _steady_state(model: ProcessModel, usual: Array) -> SteadyState | None:
    stable = [item for item in steady_states(model, usual) if item.stable]
    return stable[-1] if stable else None


def _own_states(model: ProcessModel) -> int:
    return sum(state.name not in model.at_rest for state in model.states)

"""A row through all stages of a monitor in one compiled step, for one plant as for ten thousand.

Most rows of most plants are alike: every signal has a value, the filter predicts it, no alarm changes. All that the
stages then update are numbers, in arrays that belong to the stages. A monitor of one plant steps over its stages' own
arrays (first axis 1), a fleet over arrays of all its plants; the steps themselves are in the stages' modules.

Any other row is an event, and changes nothing here: the stages process it one by one (`pipeline`), with the same
numbers. Events are: a row after a gap or a missing row; one by which the filter restarts; a value out of the signal's
range; a timeout; more equal readings than a sound sensor has; a residual that may be a spike; and a row that raises an
alarm. A point beyond a limit that raises no alarm is no event.
"""

from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from monitor_node.alarms.on_off_delay import DELAY, add_point, is_normal, raises
from monitor_node.baseline.references import GATE
from monitor_node.baseline.signal_range import signal_ranges
from monitor_node.chart_stage import alarm_names
from monitor_node.config import MonitorConfig
from monitor_node.ingest.sampling import WHOLE
from monitor_node.signal_checks.catalogue import CHECKS
from monitor_node.signal_checks.stuck import STUCK, is_stuck, take_reading
from monitor_node.signal_checks.timeout import TIMEOUT, update_timeout
from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import CompiledFunction
from reactorwatch.codegen.numba_kernel import Entry, call_at, jit
from reactorwatch.kalman.ekf_step import MODEL_CACHE_SIZE, row_function
from reactorwatch.kalman.filter_record import LONGEST_ROW_MIN
from reactorwatch.process.model import ProcessModel
from reactorwatch.spc.charts.base import LARGEST_VALUE
from reactorwatch.spc.charts.cusum import Cusum
from reactorwatch.spc.charts.cusum import _judge as judge_cusum
from reactorwatch.spc.charts.ewma import Ewma
from reactorwatch.spc.charts.ewma import _judge as judge_ewma
from reactorwatch.spc.charts.mewma import Mewma, count_numbers
from reactorwatch.spc.charts.mewma import move as move_mewma
from reactorwatch.spc.charts.shewhart import Shewhart
from reactorwatch.spc.charts.shewhart import _judge as judge_shewhart
from reactorwatch.spc.compiled_chart import PRESENT, SETTINGS, STATISTIC, CompiledChart, X
from reactorwatch.spc.prewhitening import WHITENER, expected_value, innovation

ORDINARY, VIOLATING, EVENT = 0, 1, 2
"""Verdict on a row: nothing happened; points beyond limits are remembered; nothing was changed."""

CHARTS = (Shewhart.name, Ewma.name, Cusum.name, Mewma.name)
"""Charts that the step has, in its order."""

CHECKED = {"silence", "stuck", "spike", "range"}
"""Signal checks that the step has."""

MOST_PERIODS = 1.99 - WHOLE
"""Between rows that are further apart one may be missing."""

POINT = 5
"""Numbers of a chart's point: those of a `Judgement`."""

Records: TypeAlias = NDArray[np.void]
Indices: TypeAlias = NDArray[np.int32]

TIMING = np.dtype([("last_ns", "i8"), ("period_ns", "f8"), ("time_min", "f8"), ("input", "f8")], align=True)
"""Time of the newest row, sampling period, time and input of the filter's newest row."""


class RowNumbers(NamedTuple):
    """Numbers of the stages of some plants; the first axis of each array is the plant.

    Attributes:
        timing: newest row, see `TIMING`, shape (plants,).
        timeouts: timeouts of the plant and of each signal, shape (plants, 1 + signals).
        belief: state of the filter and its covariance, shape (plants, states + states^2).
        variances: variances of the sensors and of the process, shape (plants, outputs + states).
        whiteners: shape (plants, outputs).
        stuck: shape (plants, outputs).
        spike_limits: shape (plants, outputs).
        shewhart: numbers of the charts, shape (plants, numbers of one chart, outputs); so for the next two.
        ewma: see `shewhart`.
        cusum: see `shewhart`.
        mewma: shape (plants, numbers).
        delays: delays of the charts' alarms, shape (plants, alarms).
    """

    timing: Records
    timeouts: Records
    belief: Array
    variances: Array
    whiteners: Records
    stuck: Records
    spike_limits: Array
    shewhart: Array
    ewma: Array
    cusum: Array
    mewma: Array
    delays: Records


class Outcome(NamedTuple):
    """Results of a step, for publication, and arrays to work in.

    Attributes:
        outputs: results of the filter, see `ekf_step.row_function`.
        expected: expected values of the prewhitening filters, shape (outputs,).
        e: prewhitened residuals, shape (outputs,).
        points: points of the charts, one row an alarm, shape (alarms, POINT).
        new: new values of the filter, see `ekf_step.row_function`.
        constants: constants of the filter; begin with the parameters of the model.
        belief: belief of the filter after the row.
        columns: columns of a bank of charts, see `compiled_chart`.
    """

    outputs: Array
    expected: Array
    e: Array
    points: Array
    new: Array
    constants: Array
    belief: Array
    columns: Array


class StepSettings(NamedTuple):
    """Constants of a step.

    Attributes:
        filter_address: address of the filter's machine code.
        parameters: number of parameters of the model.
        ranges: smallest and largest value of each signal, shape (signals, 2).
        silence_limit: see `DataTimeout`.
        charts: index of the first alarm of each of `CHARTS`; -1: there is no such chart.
        rules: number of violating points that raises each alarm, and mask of its window, shape (alarms, 2).
        reach: see `is_normal`.
        weight: weight of the MEWMA chart.
    """

    filter_address: int
    parameters: int
    ranges: Array
    silence_limit: float
    charts: Indices
    rules: Indices
    reach: float
    weight: float


@jit
def _copy(source: Any, i: int, into: Any, j: int) -> None:
    """Copy what a step changes."""
    into.timing[j] = source.timing[i]
    for k in range(source.timeouts.shape[1]):
        into.timeouts[j, k] = source.timeouts[i, k]
    for k in range(source.whiteners.shape[1]):
        into.whiteners[j, k] = source.whiteners[i, k]
        into.stuck[j, k] = source.stuck[i, k]
    for row in range(source.shewhart.shape[1]):
        for k in range(source.shewhart.shape[2]):
            into.shewhart[j, row, k] = source.shewhart[i, row, k]
    for row in range(source.ewma.shape[1]):
        for k in range(source.ewma.shape[2]):
            into.ewma[j, row, k] = source.ewma[i, row, k]
    for row in range(source.cusum.shape[1]):
        for k in range(source.cusum.shape[2]):
            into.cusum[j, row, k] = source.cusum[i, row, k]
    for k in range(source.mewma.shape[1]):
        into.mewma[j, k] = source.mewma[i, k]
    for k in range(source.delays.shape[1]):
        into.delays[j, k] = source.delays[i, k]


@jit
def _predict(
    timing: Any, belief: Array, variances: Array, outcome: Any, settings: Any, time_min: float, values: Array
) -> bool:
    """Filter a row that is at most two integration steps after the one before; returns True if all went well."""
    count, new, constants = values.size - 1, outcome.new, outcome.constants
    step = 0.5 * (time_min - timing.time_min)
    if not (step > 0.0 and 2.0 * step <= LONGEST_ROW_MIN):
        return False
    new[0], new[1], new[2], new[3], new[4] = timing.input, values[0], time_min, step, step
    for i in range(count):
        new[5 + i], new[5 + count + i] = values[1 + i], GATE
    for i in range(variances.size):
        constants[settings.parameters + i] = variances[i]
    before, given, known = belief.ctypes.data, new.ctypes.data, constants.ctypes.data
    call_at(settings.filter_address, (1, before, given, known, outcome.belief.ctypes.data, outcome.outputs.ctypes.data))
    return bool(outcome.outputs[outcome.outputs.size - 1] != 0.0)


@jit
def _add_point(p: Any, point: Array, settings: Any, alarm: int) -> int:
    """Update the delay of an alarm that is not active with the point of its chart; returns the verdict."""
    is_out = point[4] > 0.0
    if not (is_out or p.recent):
        return ORDINARY
    normal = not is_out and is_normal(point[0], point[1], point[2], point[3], p.above != 0, settings.reach)
    p.recent, p.in_a_row = add_point(p.recent, p.in_a_row, settings.rules[alarm, 1], is_out, normal)
    return EVENT if raises(p.recent, settings.rules[alarm, 0], is_out) else VIOLATING


@jit
def _lay_out(columns: Array, numbers: Array, e: Array) -> None:
    """Fill the columns of a bank: a new value for each chart."""
    for i in range(e.size):
        columns[X, i], columns[PRESENT, i] = e[i], 1.0
        for row in range(numbers.shape[0]):
            columns[SETTINGS + row, i] = numbers[row, i]


@jit
def _take_points(delays: Any, outcome: Any, numbers: Array, settings: Any, first: int) -> int:
    """Take over what a bank of charts has computed; returns the verdict."""
    columns, verdict = outcome.columns, ORDINARY
    for i in range(numbers.shape[1]):
        for row in range(numbers.shape[0]):
            numbers[row, i] = columns[SETTINGS + row, i]
        point = outcome.points[first + i]
        for k in range(POINT):
            point[k] = columns[STATISTIC + k, i]
        verdict = max(verdict, _add_point(delays[first + i], point, settings, first + i))
    return verdict


@jit
def _update_charts(scratch: Any, outcome: Any, settings: Any) -> int:
    """Update the charts with the prewhitened residuals; returns the verdict."""
    charts, columns, e, delays, verdict = settings.charts, outcome.columns, outcome.e, scratch.delays[0], ORDINARY
    if charts[0] >= 0:
        _lay_out(columns, scratch.shewhart[0], e)
        judge_shewhart(columns)
        verdict = max(verdict, _take_points(delays, outcome, scratch.shewhart[0], settings, charts[0]))
    if charts[1] >= 0:
        _lay_out(columns, scratch.ewma[0], e)
        judge_ewma(columns)
        verdict = max(verdict, _take_points(delays, outcome, scratch.ewma[0], settings, charts[1]))
    if charts[2] >= 0:
        _lay_out(columns, scratch.cusum[0], e)
        judge_cusum(columns)
        verdict = max(verdict, _take_points(delays, outcome, scratch.cusum[0], settings, charts[2]))
    if charts[3] >= 0:
        limit, point = scratch.mewma[0, 0], outcome.points[charts[3]]
        statistic = move_mewma(scratch.mewma[0], e, settings.weight)
        if statistic < 0.0:
            return EVENT
        point[0], point[1], point[2], point[3] = statistic, float(e.size), 0.0, limit
        point[4] = 1.0 if statistic > limit else 0.0
        verdict = max(verdict, _add_point(delays[charts[3]], point, settings, charts[3]))
    return verdict


@jit
def step(
    numbers: Any,
    scratch: Any,
    outcome: Any,
    settings: Any,
    plant: int,
    time_ns: int,
    time_min: float,
    values: Array,
) -> int:
    """Take a row through all stages; returns the verdict.

    Args:
        numbers: numbers of the plants.
        scratch: numbers of one plant, to work in.
        outcome: filled.
        settings: constants.
        plant: index of the plant.
        time_ns: time of the row.
        time_min: the same in minutes.
        values: values of the row, the input first.
    """
    _copy(numbers, plant, scratch, 0)
    timing = scratch.timing[0]
    spacing_ns = time_ns - timing.last_ns
    if spacing_ns <= 0 or float(spacing_ns) > MOST_PERIODS * timing.period_ns:
        return EVENT
    for i in range(values.size):
        if not settings.ranges[i, 0] <= values[i] <= settings.ranges[i, 1]:
            return EVENT
    belief = numbers.belief[plant]
    if not _predict(timing, belief, numbers.variances[plant], outcome, settings, time_min, values):
        return EVENT
    for i in range(scratch.timeouts.shape[1]):
        if update_timeout(scratch.timeouts[0, i], time_ns, True, settings.silence_limit, -1)[0]:
            return EVENT
    outputs = values.size - 1
    for i in range(outputs):
        value, whitener = values[1 + i], scratch.whiteners[0, i]
        take_reading(scratch.stuck[0, i], value)
        if is_stuck(scratch.stuck[0, i]):
            return EVENT
        outcome.expected[i] = expected_value(whitener)
        outcome.e[i] = innovation(whitener, (value - outcome.outputs[i]) / outcome.outputs[2 * outputs + i])
        if not (abs(outcome.e[i]) <= numbers.spike_limits[plant, i] and abs(outcome.e[i]) < LARGEST_VALUE):
            return EVENT
    verdict = _update_charts(scratch, outcome, settings)
    if verdict == EVENT:
        return EVENT
    timing.last_ns, timing.time_min, timing.input = time_ns, time_min, values[0]
    for i in range(belief.size):
        belief[i] = outcome.belief[i]
    _copy(scratch, 0, numbers, plant)
    return verdict


_STEP = Entry(step)


class RowStep:
    """The step for plants with certain settings.

    Args:
        config: settings of the plants' monitors.
        model: process model of the plants.

    Attributes:
        settings: constants of the step.
        outcome: results of the newest step.
        scratch: numbers of one plant, to work in.
    """

    def __init__(self, config: MonitorConfig, model: ProcessModel) -> None:
        outputs, states = len(config.outputs), len(model.states)
        kinds = [chart for chart, _ in alarm_names(config)]
        self._sizes = (1 + len(model.inputs) + outputs, outputs, states, len(kinds))
        self._filter = compiled_filter(model)
        rules = [(1, 1) if kind != Shewhart.name else (config.raise_count, (1 << config.window) - 1) for kind in kinds]
        ranges = signal_ranges(model, (config.input, *config.outputs))
        parameters = model.values()
        self.settings = StepSettings(
            self._filter.address,
            parameters.size,
            np.array([[item.lower, item.upper] for item in ranges]),
            float(config.silence_periods),
            np.array([kinds.index(kind) if kind in kinds else -1 for kind in CHARTS], dtype=np.int32),
            np.array(rules, dtype=np.int32).reshape(-1, 2),
            float(1 - config.dead_band),
            float(config.chart_settings["mewma_weight"]),
        )
        rows = SETTINGS + max(Shewhart.numbers, Ewma.numbers, Cusum.numbers)
        self.outcome = Outcome(
            np.empty(5 * outputs + 1),
            np.empty(outputs),
            np.empty(outputs),
            np.empty((len(kinds), POINT)),
            np.empty(5 + 2 * outputs),
            np.concatenate([parameters, np.empty(outputs + states)]),
            np.empty(states + states**2),
            np.empty((rows, outputs)),
        )
        self.scratch = self.shape(1, np.zeros)

    @staticmethod
    def of(config: MonitorConfig, model: ProcessModel | None) -> "RowStep | None":
        """The step for plants with these settings; None if their rows are not such that it could take them.

        Args:
            config: settings of the plants' monitors.
            model: process model of the plants; None: there is none.
        """
        if model is None or model.breakpoints or len(model.input_names) != 1 or model.output_names != config.outputs:
            return None
        if {check.name for check in CHECKS} != CHECKED or not set(config.charts) <= set(CHARTS):
            return None
        return None if len(config.outputs) < 2 and Mewma.name in config.charts else RowStep(config, model)

    def shape(self, plants: int, make: Any) -> RowNumbers:
        """Numbers of some plants, made by a function of shape and type."""
        timeouts, outputs, states, alarms = self._sizes
        f8, mewma = np.dtype(np.float64), count_numbers(outputs) if self.settings.charts[3] >= 0 else 0
        kinds: tuple[type[CompiledChart], ...] = (Shewhart, Ewma, Cusum)
        counts = [kind.numbers if self.settings.charts[i] >= 0 else 0 for i, kind in enumerate(kinds)]
        return RowNumbers(
            timing=make((plants,), TIMING),
            timeouts=make((plants, timeouts), TIMEOUT),
            belief=make((plants, states + states**2), f8),
            variances=make((plants, outputs + states), f8),
            whiteners=make((plants, outputs), WHITENER),
            stuck=make((plants, outputs), STUCK),
            spike_limits=make((plants, outputs), f8),
            shewhart=make((plants, counts[0], outputs), f8),
            ewma=make((plants, counts[1], outputs), f8),
            cusum=make((plants, counts[2], outputs), f8),
            mewma=make((plants, mewma), f8),
            delays=make((plants, alarms), DELAY),
        )

    def update(self, numbers: RowNumbers, time_ns: int, time_min: float, values: Array) -> int:
        """Take a row of one plant through all stages; returns the verdict."""
        verdict: int = _STEP.call(numbers, self.scratch, self.outcome, self.settings, 0, time_ns, time_min, values)
        return verdict


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def compiled_filter(model: ProcessModel) -> CompiledFunction:
    """Machine code of the filter of a model, row by row."""
    return CompiledFunction(row_function(model))

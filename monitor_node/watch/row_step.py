"""A row through all stages of a monitor in one compiled step.

Most rows of most plants are alike: every signal has a value, the filter predicts it, no alarm changes. All that the
stages then update are numbers: one record a plant (`row_frame`). The steps themselves are in the stages' modules. The
step is the same machine code for all plants.

Any other row is an event, and changes nothing here: the stages process it one by one (`pipeline`), with the same
numbers. Events are: a row after a gap or a missing row; one by which the filter restarts; a value out of the signal's
range; a timeout; more equal readings than a sound sensor has; a residual that may be a spike; and a row that raises an
alarm. A point beyond a limit that raises no alarm is no event.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from monitor_node.alarms.alarms import add_point, is_ordinary, raises
from monitor_node.charts.chart_design import alarm_names
from monitor_node.checks.signal_checks import CHECKS
from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import WHOLE
from monitor_node.learn.references import FilterReference, Reference
from monitor_node.watch.row_frame import (
    CHARTS,
    POINT,
    FrameTypes,
    Records,
    Words,
    frame_of,
    frame_types,
    plant_at,
    scratch_at,
    settings_at,
    words_of,
    work_at,
)
from monitor_node.watched_process import SignalRange
from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import CompiledFunction
from reactorwatch.codegen.numba_kernel import Entry, borrow, call_at, inline, jit
from reactorwatch.identification.black_box_filter import JUDGED, filter_row
from reactorwatch.kalman.batch import GATE
from reactorwatch.kalman.ekf_step import fill_row
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc.charts.base import LARGEST_VALUE
from reactorwatch.spc.charts.cusum import _judge as judge_cusum
from reactorwatch.spc.charts.ewma import _judge as judge_ewma
from reactorwatch.spc.charts.level import LIMIT
from reactorwatch.spc.charts.level import move as move_levels
from reactorwatch.spc.charts.mewma import Mewma
from reactorwatch.spc.charts.mewma import move as move_mewma
from reactorwatch.spc.charts.shewhart import Shewhart
from reactorwatch.spc.charts.shewhart import _judge as judge_shewhart
from reactorwatch.spc.compiled_chart import PRESENT, SETTINGS, STATISTIC, X
from reactorwatch.spc.prewhitening import innovation
from reactorwatch.spc.silence import update_timeout
from reactorwatch.spc.stuck import is_stuck, quantise, take_reading

ORDINARY, VIOLATING, EVENT = 0, 1, 2
"""Verdict on a row: nothing happened; points beyond limits are remembered; nothing was changed."""

CHECKED = {"silence", "stuck", "spike", "range"}
"""Signal checks that the step has."""

_fill_row = jit(fill_row)


@inline
def _predict(
    p: Any,
    belief: Array,
    variances: Array,
    parameters: Array,
    after: Array,
    work: Any,
    settings: Any,
    time_min: float,
    values: Array,
) -> bool:
    """Filter a row that is not too far from the one before; returns True if all went well."""
    inputs, new, constants = p.inputs.size, work.new, settings.constants[0]
    spacing_min = time_min - p.head[0].time_min
    if not constants.spacing_min[0] < spacing_min <= constants.spacing_min[1]:
        return False
    step = 0.5 * spacing_min
    _fill_row(new, p.inputs, values[:inputs], time_min, step, step, values[inputs:], GATE)
    first = parameters.size - variances.size
    for i in range(variances.size):
        parameters[first + i] = variances[i]
    if constants.filter_address == 0:
        return filter_row(belief, new, parameters, after, work.outputs) == JUDGED
    before, given, fixed = belief.ctypes.data, new.ctypes.data, parameters.ctypes.data
    call_at(constants.filter_address, (1, before, given, fixed, after.ctypes.data, work.outputs.ctypes.data))
    return bool(work.outputs[work.outputs.size - 1] != 0.0)


@inline
def _add_point(p: Any, point: Array, settings: Any, alarm: int) -> int:
    """Update the delay of an alarm that is not active with the point of its chart; returns the verdict."""
    is_out = point[4] > 0.0
    if not (is_out or p.recent):
        return ORDINARY
    reach, above = settings.constants[0].reach, p.above != 0
    ordinary = not is_out and is_ordinary(point[0], point[1], point[2], point[3], above, reach)
    p.recent, p.in_a_row = add_point(p.recent, p.in_a_row, settings.rules[alarm, 1], is_out, ordinary)
    return EVENT if raises(p.recent, settings.rules[alarm, 0], is_out) else VIOLATING


@inline
def _lay_out(columns: Array, numbers: Array, e: Array) -> None:
    """Fill the columns of a bank: a new value for each chart."""
    for i in range(e.size):
        columns[X, i], columns[PRESENT, i] = e[i], 1.0
        for row in range(numbers.shape[0]):
            columns[SETTINGS + row, i] = numbers[row, i]


@inline
def _take_points(p: Any, work: Any, numbers: Array, settings: Any, first: int) -> int:
    """Take over what a bank of charts has computed; returns the verdict."""
    columns, points, verdict = work.columns, work.points, ORDINARY
    for i in range(numbers.shape[1]):
        for row in range(numbers.shape[0]):
            numbers[row, i] = columns[SETTINGS + row, i]
        for k in range(POINT):
            points[first + i, k] = columns[STATISTIC + k, i]
        verdict = max(verdict, _add_point(p.delays[first + i], points[first + i], settings, first + i))
    return verdict


@inline
def _update_charts(p: Any, work: Any, settings: Any, values: Array) -> int:
    """Update the charts with the prewhitened residuals and the values of the signals; returns the verdict."""
    constants, columns, e, verdict = settings.constants[0], work.columns, work.e, ORDINARY
    charts = constants.charts
    if charts[0] >= 0:
        _lay_out(columns, p.shewhart, e)
        judge_shewhart(columns)
        verdict = max(verdict, _take_points(p, work, p.shewhart, settings, charts[0]))
    if charts[1] >= 0:
        _lay_out(columns, p.ewma, e)
        judge_ewma(columns)
        verdict = max(verdict, _take_points(p, work, p.ewma, settings, charts[1]))
    if charts[2] >= 0:
        _lay_out(columns, p.cusum, e)
        judge_cusum(columns)
        verdict = max(verdict, _take_points(p, work, p.cusum, settings, charts[2]))
    if charts[3] >= 0:
        statistic, limit, point = move_mewma(p.mewma, e, constants.weight), p.mewma[0], work.points[charts[3]]
        if statistic < 0.0:
            return EVENT
        point[0], point[1], point[2], point[3] = statistic, float(e.size), 0.0, limit
        point[4] = 1.0 if statistic > limit else 0.0
        verdict = max(verdict, _add_point(p.delays[charts[3]], point, settings, charts[3]))
    count = p.level_signals[0]
    if charts[4] >= 0 and count > 0:
        point = work.points[charts[4]]
        for i in range(count):
            work.values[i] = values[p.level_signals[1 + i]]
        statistic, limit = move_levels(p.level, work.values[:count]), p.level[LIMIT]
        if statistic < 0.0:
            return EVENT
        point[0], point[1], point[2], point[3] = statistic, 0.0, 0.0, limit
        point[4] = 1.0 if statistic > limit else 0.0
        verdict = max(verdict, _add_point(p.delays[charts[4]], point, settings, charts[4]))
    return verdict


@jit
def step(
    numbers: Words,
    frame: Words,
    belief: Array,
    variances: Array,
    parameters: Array,
    after: Array,
    time_ns: int,
    time_min: float,
    values: Array,
) -> int:
    """Take a row through all stages; returns the verdict.

    Args:
        numbers: numbers of the plant, see `words_of`.
        frame: see `frame_of`.
        belief: state and covariance of the filter, shape (states + states^2,); of a black box see `BlackBoxFilter`.
        variances: variances of the sensors and of the process, shape (outputs + states,); of a black box all its
            constants.
        parameters: parameters of the model, and room for the variances, shape (parameters + outputs + states,).
        after: belief of a filter, to work in.
        time_ns: time of the row.
        time_min: the same in minutes.
        values: values of the row, the inputs first.
    """
    kept, belief, noise = borrow(numbers), borrow(belief), borrow(variances)
    values, parameters, after = borrow(values), borrow(parameters), borrow(after)
    scratch = scratch_at(frame, kept.size)
    for i in range(scratch.size):
        scratch[i] = kept[i]
    p, work, settings = plant_at(frame), work_at(frame), settings_at(frame)
    head = p.head[0]
    spacing_ns = time_ns - head.last_ns
    # rows that are further apart may have one missing between them
    if spacing_ns <= 0 or float(spacing_ns) > (1.99 - WHOLE) * head.period_ns:
        return EVENT
    for i in range(values.size):
        if not settings.ranges[i, 0] <= values[i] <= settings.ranges[i, 1]:
            return EVENT
    if not _predict(p, belief, noise, parameters, after, work, settings, time_min, values):
        return EVENT
    for i in range(p.timeouts.size):
        if update_timeout(p.timeouts[i], time_ns, True, settings.constants[0].silence_limit, -1)[0]:
            return EVENT
    inputs = p.inputs.size
    outputs = values.size - inputs
    for i in range(outputs):
        value, whitener = values[inputs + i], p.whiteners[i]
        take_reading(p.stuck[i], quantise(value, settings.resolutions[i]))
        if is_stuck(p.stuck[i]):
            return EVENT
        work.e[i] = innovation(whitener, (value - work.outputs[i]) / work.outputs[2 * outputs + i])
        if not (abs(work.e[i]) <= p.spike_limits[i] and abs(work.e[i]) < LARGEST_VALUE):
            return EVENT
    verdict = _update_charts(p, work, settings, values)
    if verdict == EVENT:
        return EVENT
    head.last_ns, head.time_min = time_ns, time_min
    for i in range(inputs):
        p.inputs[i] = values[i]
    for i in range(belief.size):
        belief[i] = after[i]
    for i in range(scratch.size):
        kept[i] = scratch[i]
    return verdict


_STEP = Entry(step)


class OrdinaryRows:
    """Compiled step of one plant, with the numbers that it updates.

    Attributes:
        numbers: numbers of the stages, shape (1,), see `row_frame.FrameTypes`.
        reference: the reference whose rows the step takes; None where there is no step.
    """

    def __init__(self, config: MonitorConfig, ranges: Sequence[SignalRange]) -> None:
        self._config, self._types = config, types_of(config)
        self._row = np.empty(len(config.signals))
        self._scratch, self._work = np.zeros(1, self._types.numbers), np.zeros(1, self._types.work)
        self._settings = np.zeros(1, self._types.settings)
        kinds = [chart for chart, _ in alarm_names(config)]
        p = self._settings[0]
        constants = p["constants"]
        constants["silence_limit"] = config.silence_periods
        p["resolutions"] = [config.resolution.get(name, 0.0) for name in config.outputs]
        p["ranges"] = [[item.lower, item.upper] for item in ranges]
        constants["charts"] = [kinds.index(kind) if kind in kinds else -1 for kind in CHARTS]
        for i, kind in enumerate(kinds):
            p["rules"][i] = (1, 1) if kind != Shewhart.name else (config.raise_count, (1 << config.window) - 1)
        constants["reach"], constants["weight"] = 1 - config.dead_band, config.chart_settings["mewma_weight"]
        sizes = len(config.inputs), len(config.outputs), len(kinds)
        self._frame = frame_of(sizes, self._scratch, self._work, self._settings)
        self.numbers: Records = np.zeros(1, self._types.numbers)
        self._words = words_of(self.numbers)
        self._filter: tuple[Array, Array, Array, Array] | None = None
        self._code: CompiledFunction | None = None
        self.reference: FilterReference | None = None

    def start(self, reference: Reference) -> None:
        """Make the step of a reference, if there is one."""
        self.stop()
        if reference.filter is None or not has_step(self._config):
            return
        row_filter = reference.filter.row_filter(self._config.inputs, self._config.outputs)
        if row_filter is None:
            return
        self.reference, self._code = reference.filter, row_filter.code  # the object owns the machine code
        constants = self._settings[0]["constants"]
        constants["filter_address"] = 0 if row_filter.code is None else row_filter.code.address
        constants["spacing_min"] = row_filter.spacing_min
        belief, variances = reference.filter.numbers
        parameters = np.concatenate([row_filter.parameters, np.empty(variances.size)])
        self._filter = belief, variances, parameters, np.empty(belief.size)

    def stop(self) -> None:
        """Take no row, until the next start."""
        self._filter = self.reference = None

    def take(self, time_ns: int, values: Sequence[float]) -> int:
        """Take a row through all stages; returns the verdict, see `step`."""
        assert self._filter is not None
        self._row[:] = values
        verdict: int = _STEP.call(self._words, self._frame, *self._filter, time_ns, time_ns / MINUTE_NS, self._row)
        return verdict

    @property
    def results(self) -> tuple[list[float], list[float], list[float], Array]:
        """Results of the newest row.

        Predictions, their standard deviations, normalised residuals, and the points of the charts, see
        `ChartWatch.points`.
        """
        work, count = self._work[0], len(self._config.outputs)
        outputs = work["outputs"].tolist()
        return outputs[:count], outputs[2 * count : 3 * count], outputs[3 * count : 4 * count], work["points"]


def has_step(config: MonitorConfig) -> bool:
    """True if the step has the charts and checks of these settings."""
    if not config.inputs or {check.name for check in CHECKS} != CHECKED or not set(config.charts) <= set(CHARTS):
        return False
    return len(config.outputs) > 1 or Mewma.name not in config.charts


def types_of(config: MonitorConfig) -> FrameTypes:
    """Types of the records of the step for a plant with these settings."""
    return frame_types(len(config.inputs), len(config.outputs), len(alarm_names(config)))

"""Rows of many plants in which nothing happens, judged by compiled code.

Most rows of most plants are alike: every signal has come, in its order; the filter predicts them; no chart's alarm is
raised and no signal is suspicious. For these, all that a monitor remembers of a plant is one record of numbers, and one
loop takes them from row to row. It does what `PlantPipeline` does with such a row, operation by operation, so the
numbers are the same bits; the charts' own kernels judge here as well.

Whatever is out of the ordinary is not dealt with here. The record is then left as it was before the row, and the row is
called *odd*: the plant's own monitor evaluates it (see `plants`).

Odd are: a sample out of its order, that does not follow from those before it, of another unit or quality, or with a
value, number or time that no plant has; a row after a gap or a missing row; one by which the filter begins anew; a
value out of the signal's range; a silence; equal readings beyond a sensor's limit; a residual that may be a spike;
and a row that raises an alarm. Points beyond a limit that raise no alarm are ordinary, they are only remembered.
"""

from typing import Any

import numpy as np

from monitor_node.ingest.sampling import WHOLE
from monitor_node.quiet.layout import LEVELS, Array, Bytes, Ints, Places, Records
from monitor_node.quiet.ring import VALUE_BYTES, ZERO
from monitor_node.quiet.samples import allowed_ns
from monitor_node.signal_checks.stuck import AT_REST, MOVEMENT_STEPS
from monitor_node.signal_checks.timeout import MEMORY
from reactorwatch.codegen.numba_kernel import call_at, jit
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc.charts.base import LARGEST_VALUE
from reactorwatch.spc.charts.cusum import Cusum
from reactorwatch.spc.charts.cusum import _judge as _judge_cusum
from reactorwatch.spc.charts.ewma import Ewma
from reactorwatch.spc.charts.ewma import _judge as _judge_ewma
from reactorwatch.spc.charts.mewma import _move as _move_mewma
from reactorwatch.spc.charts.shewhart import Shewhart
from reactorwatch.spc.charts.shewhart import _judge as _judge_shewhart
from reactorwatch.spc.compiled_chart import LOWER, OUT, PRESENT, SETTINGS, STATISTIC, UPPER, X
from reactorwatch.spc.prewhitening import LARGEST_ORDER

ORDINARY, NEW_MINUTE, ODD = 0, 1, 2
"""What a row was; in the second case the figures of the alarms are due, too."""

_MINUTE_NS = int(MINUTE_NS)
_MOST_NUMBERS = max(Shewhart.numbers, Ewma.numbers, Cusum.numbers)
_STRETCH, _ORDER, _MEMORY = MOVEMENT_STEPS, LARGEST_ORDER, MEMORY
_MOST_PERIODS = 1.99 - WHOLE  # between rows that are further apart one may be missing


@jit
def _predicted(
    p: Any,
    row_time_ns: int,
    time_min: float,
    values: Array,
    ranges: Array,
    filter_address: int,
    longest_row_min: float,
    gate: float,
    new: Array,
    constants: Array,
    after: Array,
    told: Array,
) -> bool:
    """Let the filter go on from a record by a row, see `filter_step.row_function`; whether the row is ordinary to it.

    Args:
        p: record of the plant; the filter's memory stays as it is.
        row_time_ns: time of the row.
        time_min: the same in minutes.
        values: of the row, input first.
        ranges: of each signal, see `judge`.
        filter_address: of the filter's machine code.
        longest_row_min: so soon after the row before two steps lead to it.
        gate: see `references`.
        new: to work in.
        constants: to work in; begins with the parameters of the model.
        after: filled: what the filter remembers after it.
        told: filled: what it said.
    """
    outputs = values.size - 1
    spacing = row_time_ns - p.last_ns
    step = 0.5 * (time_min - p.time_min)
    if p.odd or spacing <= 0 or float(spacing) > _MOST_PERIODS * p.period_ns:
        return False
    if not (step > 0.0 and 2.0 * step <= longest_row_min):
        return False
    for place in range(values.size):
        if not ranges[place, 0] <= values[place] <= ranges[place, 1]:
            return False
    new[0], new[1], new[2], new[3], new[4] = p.input, values[0], time_min, step, step
    for place in range(outputs):
        new[5 + place], new[5 + outputs + place] = values[1 + place], gate
    parameters = constants.size - p.variance.size
    for place in range(p.variance.size):
        constants[parameters + place] = p.variance[place]
    remembered, given, known = p.memory.ctypes.data, new.ctypes.data, constants.ctypes.data
    call_at(filter_address, (1, remembered, given, known, after.ctypes.data, told.ctypes.data))
    return bool(told[told.size - 1] != 0.0)


@jit
def _hear(p: Any, spacing: int, limit: float) -> bool:
    """Look for silence; whether there is none."""
    for place in range(p.silence_count.size):
        count, mean, deviation = p.silence_count[place], p.silence_mean[place], p.silence_deviation[place]
        if count == _MEMORY and deviation == 0.0 and float(spacing) == mean:
            continue  # there is nothing to learn
        allowed = allowed_ns(limit, count, mean, deviation)
        if allowed >= 0 and spacing > allowed:
            return False
        count = min(count + 1, _MEMORY)
        off = float(spacing) - mean
        mean += off / count
        if count > 1:
            deviation += (abs(off) - deviation) / count
        p.silence_count[place], p.silence_mean[place], p.silence_deviation[place] = count, mean, deviation
    return True


@jit
def _step(p: Any, place: int, size: float) -> None:
    if p.stepped[place] == _STRETCH:
        for k in range(_STRETCH - 1):
            p.steps[place, k] = p.steps[place, k + 1]
        p.steps[place, _STRETCH - 1] = size
    else:
        p.steps[place, p.stepped[place]] = size
        p.stepped[place] += 1


@jit
def _moves(p: Any, place: int, value: float) -> bool:
    """Count equal readings; whether the sensor is not stuck."""
    if value == p.last[place]:
        p.repeats[place] += 1
        total = 0.0
        for k in range(p.stepped[place]):
            total += p.steps[place, k]
        moved = p.stepped[place] == _STRETCH and total / _STRETCH >= AT_REST * p.quietest[place]
        return not (moved and p.repeats[place] + 1.0 > p.equal_limit[place])
    for _ in range(min(p.repeats[place], _STRETCH)):
        _step(p, place, 0.0)
    p.repeats[place] = 0
    _step(p, place, abs(value - p.last[place]))
    p.last[place] = value
    return True


@jit
def _whitened(p: Any, place: int, z: float) -> float:
    """As `Prewhitener.update`."""
    expected = p.constant[place]
    for k in range(p.order[place]):
        expected += p.coefficients[place, k] * p.past[place, k]
    for k in range(_ORDER - 1, 0, -1):
        p.past[place, k] = p.past[place, k - 1]
    p.past[place, 0] = z
    return float((z - expected) / p.sigma[place])


@jit
def _noted(
    p: Any,
    alarm: int,
    out: bool,
    statistic: float,
    centre: float,
    lower: float,
    upper: float,
    rules: Places,
    reach: float,
) -> bool:
    """Follow the rule of an alarm that does not stand; whether it is not raised. As `ChartAlarm.evaluate`."""
    if not (out or p.recent[alarm]):
        return True
    p.recent[alarm] = ((p.recent[alarm] << 1) | (1 if out else 0)) & rules[alarm, 1]
    off = statistic - centre
    back_in = off <= reach * (upper - centre) if p.above[alarm] else off >= reach * (lower - centre)
    p.in_a_row[alarm] = p.in_a_row[alarm] + 1 if back_in and not out else 0
    ones, bits = 0, p.recent[alarm]
    while bits:
        ones += bits & 1
        bits >>= 1
    return not (out and ones >= rules[alarm, 0])


@jit
def _each(p: Any, columns: Array, first: int, rules: Places, reach: float) -> bool:
    """Take in what the charts of the outputs, of one kind, have said; whether they raise no alarm."""
    for place in range(columns.shape[1]):
        said = columns[STATISTIC, place], columns[STATISTIC + 1, place], columns[LOWER, place], columns[UPPER, place]
        if not _noted(p, first + place, columns[OUT, place] > 0.0, said[0], said[1], said[2], said[3], rules, reach):
            return False
    return True


@jit
def _lay_out(columns: Array, numbers: Array, e: Array) -> None:
    """The columns of a bank, see `compiled_chart`: a new value for each chart."""
    for place in range(e.size):
        columns[X, place], columns[PRESENT, place] = e[place], 1.0
        for row in range(numbers.shape[0]):
            columns[SETTINGS + row, place] = numbers[row, place]


@jit
def _put_back(columns: Array, numbers: Array) -> None:
    for row in range(numbers.shape[0]):
        for place in range(numbers.shape[1]):
            numbers[row, place] = columns[SETTINGS + row, place]


@jit
def _charted(p: Any, e: Array, columns: Array, charts: Places, rules: Places, reach: float, weight: float) -> bool:
    """Let the charts judge; whether none raises an alarm."""
    if charts[0] >= 0:
        _lay_out(columns, p.shewhart, e)
        _judge_shewhart(columns)
        _put_back(columns, p.shewhart)
        if not _each(p, columns, charts[0], rules, reach):
            return False
    if charts[1] >= 0:
        _lay_out(columns, p.ewma, e)
        _judge_ewma(columns)
        _put_back(columns, p.ewma)
        if not _each(p, columns, charts[1], rules, reach):
            return False
    if charts[2] >= 0:
        _lay_out(columns, p.cusum, e)
        _judge_cusum(columns)
        _put_back(columns, p.cusum)
        if not _each(p, columns, charts[2], rules, reach):
            return False
    if charts[3] >= 0:
        squares = _move_mewma(p.average, e, p.mean, p.whitening, weight)
        if squares < 0.0:
            return False
        statistic = squares * (2.0 - weight) / weight
        out = statistic > p.mewma_limit
        return _noted(p, charts[3], out, statistic, float(e.size), 0.0, p.mewma_limit, rules, reach)
    return True


@jit
def _level(p: Any, bits: int) -> int:
    """Which level the input is at, perhaps a new one in place of one that no row has; `LEVELS` if there is none."""
    free = LEVELS
    for level in range(LEVELS):
        if p.level_rows[level] == 0:
            free = min(free, level)
        elif p.levels[level] == bits:
            return level
    if free < LEVELS:
        p.levels[free] = bits
    return free


@jit
def _keep(p: Any, row: Bytes, others: Ints, bits: Ints) -> None:
    """Put a row into the ring, see `ring.Kept`."""
    if p.kept == others.size and row[0] < LEVELS:
        p.level_rows[row[0]] -= 1  # of the row that goes
    level = _level(p, bits[0])
    row[0] = level
    if level < LEVELS:
        p.level_rows[level] += 1
    else:
        others[p.head] = bits[0]
    for place in range(bits.size - 1):
        code = bits[1 + place] - p.reference[place] if bits[1 + place] else ZERO
        for byte in range(VALUE_BYTES):
            row[1 + VALUE_BYTES * place + byte] = code >> 8 * byte & 0xFF


@jit
def judge(
    plants: Records,
    scratch: Records,
    times: Places,
    ring: Bytes,
    others: Ints,
    rows: Places,
    row_time_ns: Ints,
    row_time_min: Array,
    row_values: Array,
    row_bits: Ints,
    filter_address: int,
    parameters: Array,
    ranges: Array,
    longest_row_min: float,
    gate: float,
    silence_limit: float,
    charts: Places,
    rules: Places,
    reach: float,
    weight: float,
    found: Places,
) -> None:
    """Judge rows, those of a plant one after the other.

    Args:
        plants: records; those of ordinary rows go on.
        scratch: one record, to work in.
        times: of the newest rows, the spacing before each, see `record_type`; shape (plants, rows kept).
        ring: their values, see `ring.Kept`, shape (plants, rows kept, bytes); without columns if causes are not
            looked for.
        others: inputs at no level, likewise, shape (plants, rows kept).
        rows: the plant of each row.
        row_time_ns: its time.
        row_time_min: the same in minutes.
        row_values: its values, input first.
        row_bits: the same as bits.
        filter_address: of the filter's machine code.
        parameters: of the model.
        ranges: smallest and largest value of each signal, shape (signals, 2), see `signal_range`.
        longest_row_min: see `_predicted`.
        gate: likewise.
        silence_limit: periods.
        charts: of Shewhart, EWMA, CUSUM and MEWMA, the place of the first alarm; -1: there is no such chart.
        rules: of each alarm of a chart, how many points out raise it, and a bit for each that is looked at.
        reach: how near to the centre is back in.
        weight: of the MEWMA chart.
        found: filled with what each was; after a row that was odd, all of its plant are.
    """
    outputs = row_values.shape[1] - 1
    e, columns = np.empty(outputs), np.empty((SETTINGS + _MOST_NUMBERS, outputs))
    memory, noise = scratch[0].memory.size, scratch[0].variance.size
    new, constants = np.empty(3 + 2 * row_values.shape[1]), np.empty(parameters.size + noise)
    after, told = np.empty(memory), np.empty(5 * outputs + 1)
    for place in range(parameters.size):  # a slice would take two seconds to compile
        constants[place] = parameters[place]
    keeps, kept = times.shape[1], ring.shape[2] > 0
    for k in range(rows.size):
        slot = rows[k]
        scratch[0] = plants[slot]
        p = scratch[0]
        ordinary = _predicted(
            p,
            row_time_ns[k],
            row_time_min[k],
            row_values[k],
            ranges,
            filter_address,
            longest_row_min,
            gate,
            new,
            constants,
            after,
            told,
        )
        spacing = row_time_ns[k] - p.last_ns
        over = spacing - p.usual_ns
        ordinary = ordinary and over % p.unit_ns == 0 and abs(over // p.unit_ns) < 2**31
        for place in range(outputs if kept else 0):
            off = row_bits[k, 1 + place] - p.reference[place]
            ordinary = ordinary and (row_bits[k, 1 + place] == 0 or ZERO < off < -ZERO)
        ordinary = ordinary and _hear(p, spacing, silence_limit)
        if ordinary:
            for place in range(outputs):
                value = row_values[k, 1 + place]
                ordinary = ordinary and _moves(p, place, value)
                z = (value - told[place]) / told[2 * outputs + place]
                e[place] = _whitened(p, place, z)
                ordinary = ordinary and abs(e[place]) <= p.spike_limit[place] and abs(e[place]) < LARGEST_VALUE
        if not (ordinary and _charted(p, e, columns, charts, rules, reach, weight)):
            found[k] = ODD
            plants[slot].odd = 1
            continue
        p.last_ns, p.spacing_ns = row_time_ns[k], spacing
        p.time_min, p.input = row_time_min[k], row_values[k, 0]
        for place in range(memory):
            p.memory[place] = after[place]
        p.rows_watched += 1
        if times[slot, p.head] != over // p.unit_ns:  # or a page of zeros would take memory
            times[slot, p.head] = over // p.unit_ns
        if kept:
            _keep(p, ring[slot, p.head], others[slot], row_bits[k])
        p.head = p.head + 1 if p.head + 1 < keeps else 0
        p.kept = min(p.kept + 1, keeps)
        minute = row_time_ns[k] // _MINUTE_NS
        found[k] = ORDINARY if minute == p.kpi_minute else NEW_MINUTE
        p.kpi_minute = minute
        plants[slot] = scratch[0]

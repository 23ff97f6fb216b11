"""All the charts of one plant: built from its training and its budget of false alarms, fed row by row.

What comes in is one prewhitened residual an output, in standard deviations, and the measured values. Which charts look
at them is a setting; the charts there are: `reactorwatch.spc.charts.catalogue`. A chart is restarted when its alarm is
cleared, so that false alarms do not come in clusters.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress, islice
from math import nan
from typing import NamedTuple, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from monitor_node.alarms.alarms import ChartAlarm, Explanation, SuspectedCause, chart_point
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.config import MonitorConfig, PriorityName
from monitor_node.ingest.alignment import MeasuredRow
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.spc import false_alarm_budget
from reactorwatch.spc.baseline import Baseline, complete_rows, memory_sds
from reactorwatch.spc.charts.base import Chart, Judgement, Shown, SignalChart
from reactorwatch.spc.charts.catalogue import chart
from reactorwatch.spc.charts.mewma import Mewma
from reactorwatch.spc.charts.shewhart import designed_width
from reactorwatch.spc.compiled_chart import Bank, CompiledChart, SignalState
from reactorwatch.spc.detection import Detector
from reactorwatch.spc.joint_chart import JointChart
from reactorwatch.spc.m_of_n import false_alarm_rates
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.training_errors import TrainingErrors
from reactorwatch.spc.value_chart import ValueBaseline, ValueChart
from reactorwatch.stored_state import StoredState

Array = NDArray[np.float64]

ALL = "all"
"""Name in place of a signal for charts of all outputs together."""

SD = "sd"
"""The unit of what charts show: standard deviations of the residual."""

SUBSTITUTES = ("shewhart", "ewma")
"""Charts of each output that are made where the settings have charts of values only, and none of them can be made."""

MOST_ENTRIES = 3
"""Signals that an alarm names as possible entries of a disturbance."""


class ChartsState(StoredState, frozen=True):
    """State of the charts of a plant.

    Attributes:
        charts: state of each chart as bytes, by name.
        widths: see `ChartWatch`.
        passed: for each output, the part of a lasting shift that its prewhitened residual shows.
    """

    charts: dict[str, bytes]
    widths: list[float]
    passed: list[float]


def alarm_names(config: MonitorConfig) -> list[tuple[str, str]]:
    """(chart, signal or `ALL`) of every alarm that the charts of a plant can raise."""
    names: list[tuple[str, str]] = []
    for name in config.charts:
        kind = chart(name)
        if issubclass(kind, SignalChart):
            names += [(name, signal) for signal in config.outputs]
        elif issubclass(kind, ValueChart) or (issubclass(kind, JointChart) and len(config.outputs) > 1):
            names.append((name, ALL))
    if has_values_only(config):
        names += [(name, signal) for name in SUBSTITUTES for signal in config.outputs]
    return names


def has_values_only(config: MonitorConfig) -> bool:
    """True if all charts of the settings are of values, so that there may be none after a training."""
    return all(issubclass(chart(name), ValueChart) for name in config.charts)


def count_chance_alarms(config: MonitorConfig) -> int:
    """Number of the charts' alarms that share the false alarms, with every signal monitored; see `ValueChart`."""
    of_settings = [pair for pair in alarm_names(config) if pair[0] in config.charts]
    return sum(len(config.signals) if issubclass(chart(name), ValueChart) else 1 for name, _ in of_settings)


_Judgements: TypeAlias = list[Judgement | None] | None


def _without(known: list[bool], withheld: tuple[bool, ...]) -> list[bool]:
    return [here and not outlier for here, outlier in zip(known, withheld, strict=True)]


class _ChartRow(NamedTuple):
    """A row as charts take it.

    Attributes:
        e: prewhitened residual of each output; NaN where there is none.
        known: for each output, True if it has one.
        withheld: outputs whose value may be an outlier and must not enter a memory yet.
        inputs: one value an input; NaN where missing.
        values: one value an output; NaN where missing.
    """

    e: list[float]
    known: list[bool]
    withheld: tuple[bool, ...]
    inputs: Sequence[float]
    values: Sequence[float]


class _Banked:
    """Compiled charts, one an output.

    `update` takes a row and returns the charts' judgements of it, None for a chart without a value; None in place of
    all if no chart is out, unless `always`. `_OfEach`, `_OfAll` and `_OfValues` have the same methods.
    """

    def __init__(self, bank: Bank[CompiledChart], kind: type[CompiledChart]) -> None:
        self._bank, self._has_memory = bank, kind.has_memory

    def to_bytes(self) -> bytes:
        return self._bank.state.to_bytes()

    def update(self, row: _ChartRow, *, always: bool) -> _Judgements:
        known, withheld = row.known, row.withheld
        present = _without(known, withheld) if True in withheld and self._has_memory else known
        return self._bank.judge(row.e, present, always=always)

    def restart(self, index: int) -> None:
        self._bank.restart(index)

    def explain(self, index: int, judgement: Judgement, signals: list[Shown]) -> tuple[str, dict[str, float]]:
        return self._bank.chart(index).explain(judgement, signals[index])

    @property
    def numbers(self) -> Array:
        """Settings and memory, shape (numbers of one chart, outputs)."""
        return self._bank.numbers


class _OfEach:
    """Charts without a compiled kernel, one an output."""

    def __init__(self, charts: Sequence[SignalChart]) -> None:
        self._charts = charts

    def to_bytes(self) -> bytes:
        return msgspec.msgpack.encode([item.state.to_bytes() for item in self._charts])

    def update(self, row: _ChartRow, *, always: bool) -> _Judgements:
        known = row.known
        if True in row.withheld and self._charts[0].has_memory:
            known = _without(known, row.withheld)
        judgements = [
            item.update(value) if here else None for item, value, here in zip(self._charts, row.e, known, strict=True)
        ]
        is_out = any(judgement is not None and judgement.out for judgement in judgements)
        return judgements if is_out or always else None

    def restart(self, index: int) -> None:
        self._charts[index].restart()

    def explain(self, index: int, judgement: Judgement, signals: list[Shown]) -> tuple[str, dict[str, float]]:
        return self._charts[index].explain(judgement, signals[index])


class _OfAll:
    """A chart of all outputs together.

    Args:
        joint: the chart.
        evaluated: for each output, True if the chart uses it.
    """

    def __init__(self, joint: JointChart, evaluated: list[bool]) -> None:
        self._chart = joint
        self._evaluated, self._all = evaluated, all(evaluated)
        self._last: list[float] = []

    def to_bytes(self) -> bytes:
        return self._chart.state.to_bytes()

    def update(self, row: _ChartRow, *, always: bool) -> _Judgements:
        """Update with a row; a row with a missing output is skipped."""
        e, known, withheld = row.e, row.known, row.withheld
        if not self._all:
            e, known = list(compress(e, self._evaluated)), list(compress(known, self._evaluated))
        if False in known or True in withheld:
            return None
        self._last = e
        judgement = self._chart.update(e)
        return [judgement] if judgement.out or always else None

    def restart(self, index: int) -> None:
        self._chart.restart()

    def explain(self, index: int, judgement: Judgement, signals: list[Shown]) -> tuple[str, dict[str, float]]:
        return self._chart.explain(self._last, list(compress(signals, self._evaluated)))

    @property
    def numbers(self) -> Array:
        """Numbers of a chart with a kernel."""
        assert isinstance(self._chart, Mewma)
        return self._chart.numbers


class _OfValues:
    """A chart of the measured values of all signals.

    Args:
        values: the chart.
        config: configuration of the monitor.
    """

    def __init__(self, values: ValueChart, config: MonitorConfig) -> None:
        self._chart, self._has_inputs, self.locates = values, bool(config.inputs), values.locates
        self._indices = [config.signals.index(name) for name in values.names]

    def to_bytes(self) -> bytes:
        return self._chart.state.to_bytes()

    def update(self, row: _ChartRow, *, always: bool) -> _Judgements:
        """Update with a row; one that is not predicted at all is skipped, since inputs may be beyond the training."""
        if self._has_inputs and True not in row.known:
            return None
        outputs: Sequence[float] = row.values
        if True in row.withheld:
            outputs = [nan if is_withheld else y for y, is_withheld in zip(outputs, row.withheld, strict=True)]
        x = self._chart.fill(np.array([*row.inputs, *outputs])[self._indices])
        if x is None:
            return None
        judgement = self._chart.update(x)
        return [judgement] if judgement.out or always else None

    def restart(self, index: int) -> None:
        self._chart.restart()

    def explain(self, index: int, judgement: Judgement, signals: list[Shown]) -> tuple[str, dict[str, float]]:
        return self._chart.explain()


_Charts: TypeAlias = _Banked | _OfEach | _OfAll | _OfValues


@dataclass
class _Watched:
    """Charts, with the alarm and the key of each."""

    charts: _Charts
    alarms: list[ChartAlarm]
    keys: list[str]
    at_rest: bool = True


class ChartWatch:
    """The charts of one plant.

    Args:
        config: configuration of the monitor.
        board: the alarms of the plant; those of the charts are declared here.
    """

    def __init__(self, config: MonitorConfig, board: Annunciator) -> None:
        self._config = config
        self._board = board
        self._alarms = {
            pair: board.declare(*pair, without_on_delay=chart(pair[0]).has_memory, priority=self._priority(pair[1]))
            for pair in alarm_names(config)
        }
        self._names = list[str](dict.fromkeys(name for name, _ in self._alarms))
        self._watched: dict[str, _Watched] = {}
        self._evaluated: list[bool] = []
        self._chosen: list[str] = []
        self._signals: tuple[str, ...] = ()  # of charts of values
        self._passed: list[float] = []
        self.widths: list[float] = []
        """Shewhart limits, one an output, in standard deviations; they are shown about the predictions."""

    def _priority(self, signal: str) -> PriorityName | None:
        if signal != ALL:
            return None
        ranks: tuple[PriorityName, ...] = ("low", "medium", "high", "critical")
        return max((self._config.priorities.get(name, "medium") for name in self._config.outputs), key=ranks.index)

    @property
    def is_normal(self) -> bool:
        """True if all charts are made, and at most their alarms remember points."""
        return list(self._watched) == self._names and self._board.is_at_rest(self._alarms.values())

    def load(self, p: np.void) -> None:
        """Fill the numbers of a plant, see `row_frame.row_type`, from the charts and their alarms."""
        for name, watched in self._watched.items():
            assert isinstance(watched.charts, _Banked | _OfAll)
            p[name] = watched.charts.numbers
        for delay, alarm in zip(p["delays"], self._alarms.values(), strict=False):
            rule = alarm.memory.rule
            delay["recent"], delay["in_a_row"], delay["above"] = rule.recent, rule.in_a_row, alarm.memory.above

    def store(self, p: np.void) -> None:
        """Take over into the charts what compiled steps have written into the numbers of a plant."""
        for name, watched in self._watched.items():
            assert isinstance(watched.charts, _Banked | _OfAll)
            watched.charts.numbers[:] = p[name]

    def store_delays(self, p: np.void) -> None:
        """Take over into the alarms what compiled steps have written into the numbers of a plant."""
        for (recent, in_a_row, _), alarm in zip(p["delays"].tolist(), self._alarms.values(), strict=False):
            rule = alarm.memory.rule
            rule.recent, rule.in_a_row = recent, in_a_row
        for watched in self._watched.values():
            watched.at_rest = all(alarm.is_idle for alarm in watched.alarms)

    def points(self, time_ns: int, points: Array) -> list[Publication]:
        """Publications of points of all charts.

        Args:
            time_ns: time of the row.
            points: numbers of a `Judgement` in each row, one row an alarm; shape (at least the number of alarms, 5).
        """
        paths = [path for watched in self._watched.values() for path in watched.keys]
        judgements = [
            Judgement(statistic, centre, lower, upper, out > 0.0)
            for statistic, centre, lower, upper, out in points.tolist()
        ]
        return [
            Publication(path, chart_point(time_ns, judgement))
            for path, judgement in zip(paths, judgements, strict=False)
        ]

    def choose(self, evaluated: list[bool], e: Array, values: Array) -> dict[str, str]:
        """Choose the charts that can be made; returns the others, by alarm, each with the reason.

        Args:
            evaluated: for each output, True if it is evaluated.
            e: the training's prewhitened residuals, shape (n, outputs); NaN where there is none.
            values: its measured values, shape (n, signals), the inputs first; NaN where missing, for each row of a
                signal that is left out.
        """
        rows, signals = (
            complete_rows(e, np.flatnonzero(evaluated).tolist()),
            list(compress(self._config.outputs, evaluated)),
        )
        obstacles = {
            name: why
            for name in self._names
            if issubclass(kind := chart(name), JointChart) and (why := kind.obstacle(rows, signals))
        }
        self._signals, complete = self._complete_values(values)
        obstacles |= {
            name: why
            for name in self._names
            if issubclass(kind := chart(name), ValueChart)
            and (why := kind.obstacle(complete, self._signals, self._config.chart_signals))
        }
        charts = [name for name in dict.fromkeys(self._config.charts) if name in self._names and name not in obstacles]
        self._evaluated, self._chosen = evaluated, charts or [name for name in self._names if name not in obstacles]
        return {self._alarms[name, ALL].name: why for name, why in obstacles.items()}

    @property
    def chance_alarms(self) -> int:
        """Number of their alarms that chance can raise."""
        kinds = [chart(name) for name in self._chosen]
        joint = sum(issubclass(kind, JointChart) for kind in kinds)
        of_each = sum(issubclass(kind, SignalChart) for kind in kinds) * sum(self._evaluated)
        return joint + of_each + sum(issubclass(kind, ValueChart) for kind in kinds) * len(self._signals)

    def _complete_values(self, values: Array) -> tuple[tuple[str, ...], Array]:
        """Names of the signals with values that vary, and the rows in which none of them is missing."""
        indices = np.flatnonzero(np.isfinite(values).any(axis=0))
        complete = complete_rows(values, indices.tolist())
        varies = np.ptp(complete, axis=0) > 0.0 if len(complete) else np.ones(indices.size, np.bool_)
        names = tuple(self._config.signals[index] for index in indices[varies].tolist())
        return names, complete[:, varies]

    def start(self, learned: list[Prewhitening], e: Array, values: Array, arl0: float) -> None:
        """Make the charts, after `choose`.

        Args:
            learned: from the training, one an output.
            e: the training's prewhitened residuals, shape (n, outputs); NaN where there is none.
            values: measured values of the training, see `choose`.
            arl0: run length of each alarm without a fault, in rows.
        """
        config, baseline = self._config, self._baseline(learned, e, arl0)
        p = baseline.point_probability
        self.widths, self._passed = [designed_width(p, item) for item in learned], [item.shift_gain for item in learned]

        def design_charts(kind: type[Chart]) -> _Charts:
            if issubclass(kind, SignalChart):
                return _of_each(kind, [kind.design(baseline.of([index])) for index in range(len(config.outputs))])
            if issubclass(kind, ValueChart):
                return _OfValues(kind.design(self._value_baseline(values, arl0)), config)
            assert issubclass(kind, JointChart)
            return _OfAll(kind.design(baseline.of(np.flatnonzero(self._evaluated).tolist())), self._evaluated)

        self._watch(design_charts)

    def _value_baseline(self, values: Array, arl0: float) -> ValueBaseline:
        return ValueBaseline(
            *self._complete_values(values), arl0, self._config.chart_settings, self._config.chart_signals
        )

    def _baseline(self, learned: list[Prewhitening], e: Array, arl0: float) -> Baseline:
        config = self._config
        p = false_alarm_budget.point_probability(arl0, config.raise_count, config.window)
        sds = memory_sds(e, config.chart_settings["ewma_weight"])
        return Baseline(tuple(learned), e, sds, arl0, p, config.chart_settings)

    def relative_rates(
        self, learned: list[Prewhitening], e: Array, values: Array, arl0: float, errors: TrainingErrors
    ) -> Array:
        """Rate of false alarms of all charts by the errors of the training, in shares of one alarm, shape (draws,).

        Args:
            learned: prewhitening of each output.
            e: prewhitened residuals of the training, shape (n, outputs); NaN where there is none.
            values: measured values of the training, see `choose`.
            arl0: run length of each alarm without a fault, in rows.
            errors: errors of all outputs.
        """
        baseline, evaluated = self._baseline(learned, e, arl0), np.flatnonzero(self._evaluated).tolist()
        total = np.zeros(len(errors.mean))
        for name in self._chosen:
            kind = chart(name)
            if issubclass(kind, ValueChart):
                total += kind.relative_rates(self._value_baseline(values, arl0))
                continue
            groups = [[index] for index in evaluated] if issubclass(kind, SignalChart) else [evaluated]
            assert issubclass(kind, SignalChart | JointChart)
            for group in groups:
                rates = kind.relative_rates(baseline.of(group), errors.of(group))
                total += rates if kind.has_memory else self._rule_rates(baseline, rates)
        return total

    def detectors(self, learned: list[Prewhitening], e: Array, arl0: float) -> list[Detector]:
        """The charts as moving averages, as far as they are; arguments as for `start`."""
        baseline, evaluated, found = self._baseline(learned, e, arl0), np.flatnonzero(self._evaluated).tolist(), []
        for name in self._chosen:
            kind = chart(name)
            for group in [[index] for index in evaluated] if issubclass(kind, SignalChart) else [evaluated]:
                average = kind.detector(baseline.of(group))
                if average is not None:
                    weight, level, matrix = average
                    rule = (1, 1) if kind.has_memory else (self._config.raise_count, self._config.window)
                    found.append(Detector(tuple(group), matrix, weight, level, rule))
        return found

    def _rule_rates(self, baseline: Baseline, rates: Array) -> Array:
        """Relative rate of an alarm that takes several points, from that of single points."""
        count, window, p = self._config.raise_count, self._config.window, baseline.point_probability
        nodes = np.geomspace(0.1 * p, 1.0, 40)  # rates of far rarer points are rounding errors, and nothing
        of_rule = np.maximum(false_alarm_rates(count, window, nodes) * baseline.arl0, 1e-9)
        return np.asarray(np.exp(np.interp(np.log(np.maximum(rates * p, nodes[0])), np.log(nodes), np.log(of_rule))))

    @property
    def state(self) -> ChartsState:
        """A copy of the full state of the charts; their alarms belong to the board."""
        charts = {name: watched.charts.to_bytes() for name, watched in self._watched.items()}
        return ChartsState(charts, list(self.widths), list(self._passed))

    def restore(self, state: ChartsState, evaluated: list[bool]) -> None:
        """Resume, bit for bit, from the state of charts with the same settings; after the board.

        Args:
            state: state of the other charts.
            evaluated: for each output, True if it is evaluated.

        Raises:
            ValueError: the state is damaged.
        """
        self.widths, self._passed = list(state.widths), list(state.passed)
        self._evaluated, self._chosen = evaluated, [name for name in self._names if name in state.charts]
        outputs = len(self._config.outputs)
        each = {name for name in self._names if issubclass(chart(name), SignalChart)}
        if has_values_only(self._config) and not each & set(state.charts):
            each = set()
        if not each <= set(state.charts) <= set(self._names) or not len(self.widths) == len(self._passed) == outputs:
            raise ValueError(f"there must be the charts {', '.join(self._names)}, got {', '.join(state.charts)}")

        def restore_charts(kind: type[Chart]) -> _Charts:
            data = state.charts[kind.name]
            if issubclass(kind, CompiledChart):
                columns = SignalState.from_bytes(data)
                if columns.plants != outputs:
                    raise ValueError(f"there must be {outputs} charts {kind.name}, got {columns.plants}")
                return _Banked(Bank.from_state(kind, columns), kind)
            if issubclass(kind, SignalChart):
                return _OfEach([kind.from_state(kind.State.from_bytes(item)) for item in _split(data, outputs)])
            if issubclass(kind, ValueChart):
                of_values = kind.from_state(kind.State.from_bytes(data))
                self._signals = of_values.names
                return _OfValues(of_values, self._config)
            assert issubclass(kind, JointChart)
            return _OfAll(kind.from_state(kind.State.from_bytes(data)), self._evaluated)

        self._watch(restore_charts)

    def restart(self) -> None:
        """Forget the rows seen, in all charts."""
        for watched in self._watched.values():
            for index in range(len(watched.alarms)):
                watched.charts.restart(index)

    def _watch(self, made: Callable[[type[Chart]], _Charts]) -> None:
        """Give the charts of each name their alarms and keys."""
        self._watched = {}
        for name in self._chosen:
            pairs = [pair for pair in self._alarms if pair[0] == name]
            alarms = [self._alarms[pair] for pair in pairs]
            paths = [keys.key(self._config.plant, keys.CHART, keys.chart_name(*pair)) for pair in pairs]
            self._watched[name] = _Watched(made(chart(name)), alarms, paths, all(alarm.is_idle for alarm in alarms))

    def update(
        self, row: MeasuredRow, e: list[float], withheld: tuple[bool, ...], scales: list[float], *, points: bool
    ) -> None:
        """Evaluate a row.

        Args:
            row: the row; points and alarms are added to its publications.
            e: prewhitened residuals; NaN where there is none.
            withheld: outputs whose value may be an outlier and must not enter a memory yet.
            scales: one standard deviation of each, in the outputs' units.
            points: True to publish the charts' points.
        """
        publications = row.publications
        known = [size == size for size in e]  # NaN is not equal to itself
        seen = _ChartRow(e, known, withheld, row.inputs, row.values)
        for watched in self._watched.values():
            judgements = watched.charts.update(seen, always=points or not watched.at_rest)
            if judgements is None:
                continue
            for index, (alarm, judgement) in enumerate(zip(watched.alarms, judgements, strict=True)):
                if judgement is None:
                    continue
                if points:
                    publications.append(Publication(watched.keys[index], chart_point(row.time_ns, judgement)))
                rule = alarm.memory.rule
                if not (judgement.out or rule.standing or rule.recent):
                    continue
                raised = alarm.update(judgement)
                if raised is None:
                    continue
                explanation = self._explain(watched.charts, index, judgement, scales, row.units) if raised else None
                publications.append(self._board.record_change(alarm, row.time_ns, judgement, SD, explanation))
                if explanation is not None and isinstance(watched.charts, _OfValues) and watched.charts.locates:
                    publications += self._board.set_suspects(row.time_ns, _entries(explanation.contributions))
                if not raised:
                    watched.charts.restart(index)
            rules = [alarm.memory.rule for alarm in watched.alarms]
            watched.at_rest = not any(rule.standing or rule.recent for rule in rules)

    def _explain(
        self, charts: _Charts, index: int, judgement: Judgement, scales: list[float], units: list[str]
    ) -> Explanation:
        signals = [Shown(*item) for item in zip(self._config.outputs, units, scales, self._passed, strict=True)]
        return Explanation(*charts.explain(index, judgement, signals))


def _entries(shares: Mapping[str, float]) -> list[SuspectedCause]:
    """Signals at which a disturbance may enter, the likeliest first."""
    return [
        SuspectedCause(name, share, kind="process", text=f"the disturbance enters at {name}")
        for name, share in islice(shares.items(), MOST_ENTRIES)
    ]


def _of_each(kind: type[SignalChart], charts: list[SignalChart]) -> _Charts:
    """One chart an output, as a bank where there is a kernel."""
    if issubclass(kind, CompiledChart):
        return _Banked(Bank([item for item in charts if isinstance(item, kind)]), kind)
    return _OfEach(charts)


def _split(data: bytes, count: int) -> list[bytes]:
    """The states of charts without a kernel, one an output."""
    states = msgspec.msgpack.decode(data, type=list[bytes])
    if len(states) != count:
        raise ValueError(f"there must be {count} charts, got {len(states)}")
    return states

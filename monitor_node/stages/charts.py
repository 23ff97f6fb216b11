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

from monitor_node.alarms.alarms import ChartAlarm, Explanation, SuspectedCause, chart_point
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.config import MonitorConfig, PriorityName
from monitor_node.ingest.alignment import MeasuredRow
from monitor_node.stages.chart_alarms import ALL, alarm_names, has_values_only
from monitor_node.stages.chart_design import ChartDesign
from reactorwatch.arrays import Array
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.spc.charts.base import Chart, Judgement, Shown, SignalChart
from reactorwatch.spc.charts.catalogue import chart
from reactorwatch.spc.charts.mewma import Mewma
from reactorwatch.spc.charts.shewhart import designed_width
from reactorwatch.spc.compiled_chart import Bank, CompiledChart, SignalState
from reactorwatch.spc.joint_chart import JointChart
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.value_chart import ValueChart
from reactorwatch.stored_state import StoredState

SD = "sd"
"""The unit of what charts show: standard deviations of the residual."""

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
        self._bank, self._kind, self._has_memory = bank, kind, kind.has_memory

    def to_bytes(self) -> bytes:
        return self._bank.state.to_bytes()

    def update(self, row: _ChartRow, *, always: bool) -> _Judgements:
        known, withheld = row.known, row.withheld
        present = _without(known, withheld) if True in withheld and self._has_memory else known
        return self._bank.judge(row.e, present, always=always)

    def restart(self, index: int) -> None:
        self._bank.restart(index)

    def explain(self, index: int, judgement: Judgement, signals: list[Shown]) -> tuple[str, dict[str, float]]:
        return self._kind.explain(judgement, signals[index])

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

    Attributes:
        design: design of the charts; choose the charts by it before `start`.
        widths: Shewhart limits, one an output, in standard deviations; they are shown about the predictions.
    """

    def __init__(self, config: MonitorConfig, board: Annunciator) -> None:
        self._config, self._board, self.design = config, board, ChartDesign(config)
        self._alarms = {
            pair: board.declare(*pair, without_on_delay=chart(pair[0]).has_memory, priority=self._priority(pair[1]))
            for pair in alarm_names(config)
        }
        self._watched: dict[str, _Watched] = {}
        self._passed: list[float] = []
        self.widths: list[float] = []

    def _priority(self, signal: str) -> PriorityName | None:
        if signal != ALL:
            return None
        ranks: tuple[PriorityName, ...] = ("low", "medium", "high", "critical")
        return max((self._config.priorities.get(name, "medium") for name in self._config.outputs), key=ranks.index)

    @property
    def is_normal(self) -> bool:
        """True if all charts are made, and at most their alarms remember points."""
        return list(self._watched) == self.design.names and self._board.is_at_rest(self._alarms.values())

    def load(self, p: np.void) -> None:
        """Fill the numbers of a plant, see `row_frame.FrameTypes`, from the charts and their alarms."""
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

    def start(self, learned: list[Prewhitening], e: Array, values: Array, arl0: float) -> None:
        """Make the charts that the design has chosen.

        Args:
            learned: from the training, one an output.
            e: the training's prewhitened residuals, shape (n, outputs); NaN where there is none.
            values: measured values of the training, see `ChartDesign.choose`.
            arl0: run length of each alarm without a fault, in rows.
        """
        design, baseline = self.design, self.design.baseline(learned, e, arl0)
        p = baseline.point_probability
        self.widths, self._passed = [designed_width(p, item) for item in learned], [item.shift_gain for item in learned]

        def design_charts(kind: type[Chart]) -> _Charts:
            if issubclass(kind, SignalChart):
                return _of_each(kind, [kind.design(baseline.of([index])) for index in range(len(learned))])
            if issubclass(kind, ValueChart):
                return _OfValues(kind.design(design.value_baseline(values, arl0)), self._config)
            assert issubclass(kind, JointChart)
            return _OfAll(kind.design(baseline.of(np.flatnonzero(design.evaluated).tolist())), design.evaluated)

        self._watch(design_charts)

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
        design, names = self.design, self.design.names
        self.widths, self._passed = list(state.widths), list(state.passed)
        design.evaluated, design.chosen = evaluated, [name for name in names if name in state.charts]
        outputs = len(self._config.outputs)
        each = {name for name in names if issubclass(chart(name), SignalChart)}
        if has_values_only(self._config) and not each & set(state.charts):
            each = set()
        if not each <= set(state.charts) <= set(names) or not len(self.widths) == len(self._passed) == outputs:
            raise ValueError(f"there must be the charts {', '.join(names)}, got {', '.join(state.charts)}")

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
                design.signals = of_values.names
                return _OfValues(of_values, self._config)
            assert issubclass(kind, JointChart)
            return _OfAll(kind.from_state(kind.State.from_bytes(data)), design.evaluated)

        self._watch(restore_charts)

    def restart(self) -> None:
        """Forget the rows seen, in all charts."""
        for watched in self._watched.values():
            for index in range(len(watched.alarms)):
                watched.charts.restart(index)

    def _watch(self, made: Callable[[type[Chart]], _Charts]) -> None:
        """Give the charts of each name their alarms and keys."""
        self._watched = {}
        for name in self.design.chosen:
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

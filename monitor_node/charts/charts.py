"""All the charts of one plant: built from its training and its budget of false alarms, fed row by row.

What comes in is one prewhitened residual an output, in standard deviations, and the measured values. Which charts look
at them is a setting; the charts there are: `reactorwatch.spc.charts.catalogue`. A chart is restarted when its alarm is
cleared, so that false alarms do not come in clusters.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence, Sized
from itertools import compress, islice
from math import nan
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import msgspec
import numpy as np

from monitor_node.alarms.alarms import AlarmChange, ChartAlarm, SuspectedCause
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.charts.chart_design import ALL, ChartDesign, alarm_names
from monitor_node.config import MonitorConfig, PriorityName
from monitor_node.ingest.alignment import MeasuredRow
from reactorwatch.arrays import Array
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import ChartPoint
from reactorwatch.spc.charts.base import Chart, JointChart, Judgement, Shown, SignalChart
from reactorwatch.spc.charts.catalogue import chart
from reactorwatch.spc.charts.level import Level
from reactorwatch.spc.charts.shewhart import designed_width
from reactorwatch.spc.charts.value_chart import ValueChart
from reactorwatch.spc.compiled_chart import Bank, CompiledChart, SignalMemory
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.stored_state import Memory, read_memory

SD = "sd"
"""The unit of what charts show: standard deviations of the residual."""


class ChartsMemory(Memory):
    """Memory of the charts of a plant.

    Attributes:
        charts: memory of each chart by name, of a chart of each output without a kernel a list of them; as it was read,
            until the charts go on from it.
        widths: Shewhart limits, one an output, in standard deviations; they are shown about the predictions.
        passed: for each output, the part of a lasting shift that its prewhitened residual shows.
    """

    charts: dict[str, Any] = msgspec.field(default_factory=dict)
    widths: list[float] = msgspec.field(default_factory=list)
    passed: list[float] = msgspec.field(default_factory=list)


_Judgements: TypeAlias = list[Judgement | None] | None

_Made: TypeAlias = Bank | list[SignalChart] | JointChart | ValueChart
"""Charts of one name: one an output, as a bank where there is a kernel, or one of several signals."""


class _ChartRow(NamedTuple):
    """A row as charts take it.

    Attributes:
        e: prewhitened residual of each output; NaN where there is none.
        lasting: the same as charts with a memory take it, see `RowPrediction.memory_share`.
        known: for each output, True if it has one.
        withheld: outputs whose value may be an outlier and must not enter a memory yet.
        inputs: one value an input; NaN where missing.
        values: one value an output; NaN where missing.
    """

    e: list[float]
    lasting: list[float]
    known: list[bool]
    withheld: tuple[bool, ...]
    inputs: Sequence[float]
    values: Sequence[float]

    def residuals(self, kind: type[Chart]) -> list[float]:
        """Residuals that charts of a kind take."""
        return self.lasting if kind.has_memory else self.e

    def present(self, kind: type[Chart]) -> list[bool]:
        """For each output, True if charts of a kind take its residual."""
        if True not in self.withheld or not kind.has_memory:
            return self.known
        return [known and not withheld for known, withheld in zip(self.known, self.withheld, strict=True)]


class _Charts(ABC):
    """Charts of one name.

    Attributes:
        memory: memory of these charts, see `ChartsMemory`.
        alarms: alarm of each chart.
        keys: key of each chart's points.
        locates: True if the first signals of an explanation are those at which a disturbance may enter.
        judges_unpredicted: True if rows that are not predicted are judged.
    """

    locates = judges_unpredicted = False

    def __init__(self, memory: Any) -> None:
        self.memory = memory
        self.alarms: list[ChartAlarm] = []
        self.keys: list[str] = []

    @abstractmethod
    def update(self, row: _ChartRow, *, always: bool) -> _Judgements:
        """Judge a row: None for a chart without a value; None in place of all if no chart is out, unless `always`."""

    def is_held(self, index: int, away: list[bool]) -> bool:
        """True if an alarm stays active as outputs are not back; a chart of values compares them with the training."""
        return away[index]

    @abstractmethod
    def restart(self, index: int) -> None:
        """Forget the rows seen, in the chart of an alarm."""

    @abstractmethod
    def explain(self, index: int, judgement: Judgement, signals: list[Shown]) -> tuple[str, dict[str, float]]:
        """The text of an alarm, and each signal's share of it; arguments as for `SignalChart.explain`."""


class _Banked(_Charts):
    """Compiled charts, one an output."""

    def __init__(self, bank: Bank) -> None:
        super().__init__(bank.memory)
        self._bank = bank

    def update(self, row: _ChartRow, *, always: bool) -> _Judgements:
        return self._bank.judge(row.residuals(kind := self._bank.kind), row.present(kind), always=always)

    def restart(self, index: int) -> None:
        self._bank.restart(index)

    def explain(self, index: int, judgement: Judgement, signals: list[Shown]) -> tuple[str, dict[str, float]]:
        return self._bank.kind.explain(judgement, signals[index])


class _OfEach(_Charts):
    """Charts without a compiled kernel, one an output."""

    def __init__(self, charts: Sequence[SignalChart]) -> None:
        super().__init__([item.memory for item in charts])
        self._charts = charts

    def update(self, row: _ChartRow, *, always: bool) -> _Judgements:
        kind = type(self._charts[0])
        taken = zip(self._charts, row.residuals(kind), row.present(kind), strict=True)
        judgements = [item.update(value) if here else None for item, value, here in taken]
        return judgements if always or any(item is not None and item.out for item in judgements) else None

    def restart(self, index: int) -> None:
        self._charts[index].restart()

    def explain(self, index: int, judgement: Judgement, signals: list[Shown]) -> tuple[str, dict[str, float]]:
        return self._charts[index].explain(judgement, signals[index])


Joined = TypeVar("Joined", bound=Chart)


class _Single(_Charts, Generic[Joined]):
    """One chart of several signals."""

    def __init__(self, joined: Joined) -> None:
        super().__init__(joined.memory)
        self._chart = joined

    def _judge(self, x: Any, *, always: bool) -> _Judgements:
        judgement = self._chart.update(x)
        return [judgement] if judgement.out or always else None

    def restart(self, index: int) -> None:
        self._chart.restart()


class _OfAll(_Single[JointChart]):
    """A chart of all outputs together."""

    def __init__(self, joint: JointChart, evaluated: list[bool]) -> None:
        super().__init__(joint)
        self._evaluated, self._last = evaluated, list[float]()

    def update(self, row: _ChartRow, *, always: bool) -> _Judgements:
        """Update with a row; a row with a missing output is skipped."""
        if True in row.withheld or False in compress(row.known, self._evaluated):
            return None
        self._last = list(compress(row.residuals(type(self._chart)), self._evaluated))
        return self._judge(self._last, always=always)

    def is_held(self, index: int, away: list[bool]) -> bool:
        return True in compress(away, self._evaluated)

    def explain(self, index: int, judgement: Judgement, signals: list[Shown]) -> tuple[str, dict[str, float]]:
        return self._chart.explain(self._last, list(compress(signals, self._evaluated)))


class _OfValues(_Single[ValueChart]):
    """A chart of the measured values of all signals."""

    def __init__(self, values: ValueChart, config: MonitorConfig) -> None:
        super().__init__(values)
        self.locates, self.judges_unpredicted = values.locates, not config.inputs
        self._indices = [config.signals.index(name) for name in values.names]

    def update(self, row: _ChartRow, *, always: bool) -> _Judgements:
        """Update with a row; one that is not predicted at all is skipped, since inputs may be beyond the training."""
        if True not in row.known and not self.judges_unpredicted:
            return None
        outputs = [nan if withheld else y for y, withheld in zip(row.values, row.withheld, strict=True)]
        x = self._chart.fill(np.array([*row.inputs, *outputs])[self._indices])
        return None if x is None else self._judge(x, always=always)

    def is_held(self, index: int, away: list[bool]) -> bool:
        return False

    def explain(self, index: int, judgement: Judgement, signals: list[Shown]) -> tuple[str, dict[str, float]]:
        return self._chart.explain()


class ChartWatch:
    """The charts of one plant.

    Attributes:
        design: design of the charts; choose the charts by it before `start`.
        memory: memory of the charts: what runs, and what is stored. Their alarms belong to the board.
    """

    def __init__(self, config: MonitorConfig, board: Annunciator) -> None:
        self._config, self._board, self.design = config, board, ChartDesign(config)
        self._alarms = {
            pair: board.declare(*pair, without_on_delay=chart(pair[0]).has_memory, priority=self._priority(pair[1]))
            for pair in alarm_names(config)
        }
        self._watched: dict[str, _Charts] = {}
        self._level: Level | None = None
        self.memory = ChartsMemory()

    def _priority(self, signal: str) -> PriorityName | None:
        if signal != ALL:
            return None
        ranks: tuple[PriorityName, ...] = ("low", "medium", "high", "critical")
        return max((self._config.priorities.get(name, "medium") for name in self._config.outputs), key=ranks.index)

    @property
    def away(self) -> list[bool] | None:
        """For each output, True if its level is not back, see `Level.away`; None without a chart of levels."""
        if self._level is None:
            return None
        away = self._level.away
        return [name in away for name in self._config.outputs]

    @property
    def is_ordinary(self) -> bool:
        """True if all charts are made, perhaps but the last, of levels, and at most their alarms remember points."""
        made, names = list(self._watched), self.design.names
        return names in (made, [*made, Level.name]) and self._board.is_at_rest(self._alarms.values())

    @property
    def reads_values(self) -> bool:
        """True if a chart judges the values of rows that are not predicted, other than slow changes beside others."""
        seen = {name: charts.judges_unpredicted for name, charts in self._watched.items()}
        return any(judges for name, judges in seen.items() if name != Level.name or len(seen) == 1)

    def load(self, p: np.void) -> None:
        """Fill the numbers of a plant, see `row_frame.FrameTypes`, from the charts and their alarms."""
        for name, memory in self.memory.charts.items():
            p[name][: len(memory.numbers)] = memory.numbers
        levels = self.memory.charts.get(Level.name)
        indices = [] if levels is None else [self._config.signals.index(name) for name in levels.names]
        p["level_signals"][: 1 + len(indices)] = [len(indices), *indices]
        for delay, alarm in zip(p["delays"], self._alarms.values(), strict=False):
            memory = alarm.memory
            delay["recent"], delay["in_a_row"], delay["above"] = memory.recent, memory.in_a_row, memory.above

    def store(self, p: np.void) -> None:
        """Take over into the charts what compiled steps have written into the numbers of a plant."""
        for name, memory in self.memory.charts.items():
            memory.numbers[:] = p[name][: len(memory.numbers)]

    def store_delays(self, p: np.void) -> None:
        """Take over into the alarms what compiled steps have written into the numbers of a plant."""
        for (recent, in_a_row, _), alarm in zip(p["delays"].tolist(), self._alarms.values(), strict=False):
            alarm.memory.recent, alarm.memory.in_a_row = recent, in_a_row

    def points(self, time_ns: int, points: Array) -> list[Publication]:
        """Publications of points of all charts."""
        paths = [path for charts in self._watched.values() for path in charts.keys]
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
        design, baselines = self.design, self.design.baselines(learned, e, arl0)
        p = baselines[False].point_probability
        widths, passed = [designed_width(p, item) for item in learned], [item.shift_gain for item in learned]
        self.memory = ChartsMemory({}, widths, passed)

        def design_charts(kind: type[Chart]) -> _Made:
            baseline = baselines[kind.has_memory]
            if issubclass(kind, CompiledChart):
                return Bank.of([kind.design(baseline.of([index])) for index in range(len(learned))])
            if issubclass(kind, SignalChart):
                return [kind.design(baseline.of([index])) for index in range(len(learned))]
            if issubclass(kind, ValueChart):
                return kind.design(design.value_baseline(values, arl0))
            assert issubclass(kind, JointChart)
            return kind.design(baseline.of(np.flatnonzero(design.evaluated).tolist()))

        self._watch(design_charts)

    def resume(self, memory: ChartsMemory, evaluated: list[bool]) -> None:
        """Go on, bit for bit, from the memory of charts with the same settings; after the board.

        Raises:
            ValueError: the memory is damaged.
        """
        design, names, stored = self.design, self.design.names, memory.charts
        self.memory = memory
        design.evaluated, design.chosen = evaluated, [name for name in names if name in stored]
        outputs = len(self._config.outputs)
        if not set(stored) <= set(names) or not len(memory.widths) == len(memory.passed) == outputs:
            raise ValueError(f"there must be the charts {', '.join(names)}, got {', '.join(stored)}")

        def resume_charts(kind: type[Chart]) -> _Made:
            data = stored[kind.name]
            if issubclass(kind, CompiledChart):
                bank = Bank(kind, read_memory(data, SignalMemory))
                _check_count(bank.memory.numbers.T, outputs)
                return bank
            if issubclass(kind, SignalChart):
                return [kind.resume(read_memory(item, kind.memory_type)) for item in _check_count(data, outputs)]
            made = kind.resume(read_memory(data, kind.memory_type))
            assert isinstance(made, JointChart | ValueChart)
            if isinstance(made, ValueChart):
                design.signals = made.names
            return made

        self._watch(resume_charts)

    def restart(self) -> None:
        """Forget the rows seen, in all charts."""
        for charts in self._watched.values():
            for index in range(len(charts.alarms)):
                charts.restart(index)

    def _watch(self, make: Callable[[type[Chart]], _Made]) -> None:
        """Make the charts of each name, and give them their alarms and keys."""
        made = {name: make(chart(name)) for name in self.design.chosen}
        self._level = next((item for item in made.values() if isinstance(item, Level)), None)
        self._watched = {name: self._charts(item) for name, item in made.items()}
        self.memory.charts = {name: charts.memory for name, charts in self._watched.items()}
        for name, charts in self._watched.items():
            pairs = [pair for pair in self._alarms if pair[0] == name]
            charts.alarms = [self._alarms[pair] for pair in pairs]
            charts.keys = [keys.key(self._config.plant, keys.CHART, keys.chart_name(*pair)) for pair in pairs]

    def _charts(self, made: _Made) -> _Charts:
        """Charts of one name as they take rows."""
        if isinstance(made, ValueChart):
            return _OfValues(made, self._config)
        if isinstance(made, JointChart):
            return _OfAll(made, self.design.evaluated)
        return _Banked(made) if isinstance(made, Bank) else _OfEach(made)

    def update(
        self,
        row: MeasuredRow,
        e: list[float],
        memory_share: float,
        withheld: tuple[bool, ...],
        scales: list[float],
        *,
        away: list[bool],
        points: bool,
    ) -> list[AlarmChange]:
        """Evaluate a row; returns the changes of alarms.

        Args:
            row: the row; points are added to its publications.
            e: prewhitened residuals; NaN where there is none.
            memory_share: share of them that charts with a memory take.
            withheld: outputs whose value may be an outlier and must not enter a memory yet.
            scales: one standard deviation of each, in the outputs' units.
            away: for each output, True if it is not back.
            points: True to publish the charts' points.
        """
        known = [size == size for size in e]  # NaN is not equal to itself
        lasting = e if memory_share == 1.0 else [memory_share * value for value in e]
        seen, changes = _ChartRow(e, lasting, known, withheld, row.inputs, row.values), list[AlarmChange]()
        for charts in self._watched.values():
            always = points or any(alarm.memory.standing or alarm.memory.recent for alarm in charts.alarms)
            for index, judgement in enumerate(charts.update(seen, always=always) or ()):
                if judgement is None:
                    continue
                if points:
                    row.publications.append(Publication(charts.keys[index], chart_point(row.time_ns, judgement)))
                alarm = charts.alarms[index]
                if not (judgement.out or alarm.memory.standing or alarm.memory.recent):
                    continue  # such a point changes no alarm
                change = alarm.update(judgement, SD, away=charts.is_held(index, away))
                if change is None:
                    continue
                if change.is_raised:
                    columns = self._config.outputs, row.units, scales, self.memory.passed
                    signals = [Shown(*item) for item in zip(*columns, strict=True)]
                    change.text, change.contributions = charts.explain(index, judgement, signals)
                    if charts.locates:
                        change.entries = [
                            SuspectedCause(name, share, kind="process", text=f"the disturbance enters at {name}")
                            for name, share in islice(change.contributions.items(), 3)
                        ]
                else:
                    charts.restart(index)
                changes.append(change)
        return changes


def _check_count(charts: Sized, count: int) -> Any:
    """Charts of one name, of which there must be as many as outputs."""
    if len(charts) != count:
        raise ValueError(f"there must be {count} charts, got {len(charts)}")
    return charts


def chart_point(time_ns: int, judgement: Judgement) -> ChartPoint:
    """Message of a point on a chart."""
    return ChartPoint(
        time_ns=time_ns,
        statistic=judgement.statistic,
        centre=judgement.centre,
        lower_limit=judgement.lower_limit,
        upper_limit=judgement.upper_limit,
        out=judgement.out,
    )

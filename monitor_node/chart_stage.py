"""All the charts of one plant: built from its training and its budget of false alarms, fed row by row.

What comes in is one prewhitened residual an output, in standard deviations. Which charts look at it is a setting:

- `shewhart` sees a large change within a few rows: an alarm takes several of the last points beyond its limit.
- `ewma` sees a moderate change of one output, `cusum` likewise.
- `mewma` has the longest memory and looks at all outputs together: small lasting changes.
- `t2` looks at all outputs of one row; `pca_t2` and `pca_spe` at what they have in common and what they don't.

A chart with a memory begins anew when its alarm is cleared, so that false alarms do not come in clusters.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from monitor_node.alarms.alarms import ChartAlarm, Explanation, format_quantity
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.baseline.chart_design import ChartDesign, VectorChart, joint_obstacle
from monitor_node.config import ChartName, MonitorConfig, PriorityName
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import ChartPoint
from reactorwatch.spc.charts.base import Bank, Judgement, SignalChart, SignalState
from reactorwatch.spc.charts.cusum import Cusum
from reactorwatch.spc.charts.ewma import Ewma
from reactorwatch.spc.charts.mewma import Mewma, MewmaState
from reactorwatch.spc.charts.pca import PcaModel, PcaSpe, PcaT2
from reactorwatch.spc.charts.shewhart import Shewhart
from reactorwatch.spc.charts.t2 import T2, T2State
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.stored_state import StoredState

Array = NDArray[np.float64]

ALL = "all"
"""What a chart of all outputs together is of."""

SD = "sd"
"""The unit of what charts show: standard deviations of the residual."""

OF_EACH: tuple[ChartName, ...] = ("shewhart", "ewma", "cusum")
OF_ALL: tuple[ChartName, ...] = ("t2", "mewma", "pca_t2", "pca_spe")
WITHOUT_MEMORY = ("shewhart", "t2", "pca_t2", "pca_spe")
"""An alarm of theirs takes several points, so that a single outlier raises none."""


SIGNAL_CHARTS: dict[str, type[SignalChart]] = {kind.name: kind for kind in (Shewhart, Ewma, Cusum)}


class ChartsState(StoredState, frozen=True):
    """All that the charts of a plant are and remember.

    Attributes:
        charts: by name, the state of each as bytes.
        widths: see `ChartWatch`.
        passed: of each output, the part of a lasting shift that the charts see.
    """

    charts: dict[str, bytes]
    widths: list[float]
    passed: list[float]


def alarm_names(config: MonitorConfig) -> list[tuple[str, str]]:
    """(chart, of what) of every alarm that the charts of a plant can raise."""
    of_all = OF_ALL if len(config.outputs) > 1 else ()
    names: list[tuple[str, str]] = []
    for chart in config.charts:
        if chart in OF_EACH:
            names += [(chart, signal) for signal in config.outputs]
        elif chart in of_all:
            names.append((chart, ALL))
    return names


class _OfEach:
    """Charts of one kind, one an output."""

    def __init__(self, name: str, bank: Bank[SignalChart], signals: tuple[str, ...], passed: list[float]) -> None:
        self._name, self._signals, self._passed = name, signals, passed
        self._bank = bank
        self._shows_outliers = name in WITHOUT_MEMORY

    @classmethod
    def from_bytes(cls, name: str, data: bytes, signals: tuple[str, ...], passed: list[float]) -> "_OfEach":
        """The charts that go on where they were."""
        state = SignalState.from_bytes(data)
        if state.plants != len(signals):
            raise ValueError(f"there must be {len(signals)} charts {name}, got {state.plants}")
        return cls(name, Bank.from_state(SIGNAL_CHARTS[name], state), signals, passed)

    def to_bytes(self) -> bytes:
        """All that the charts are and remember."""
        return self._bank.state.to_bytes()

    def update(self, e: list[float], known: list[bool], withheld: tuple[bool, ...]) -> bool:
        """Take a row in; whether any chart is out."""
        if True in withheld and not self._shows_outliers:
            known = [here and not outlier for here, outlier in zip(known, withheld, strict=True)]
        self._known = known
        return self._bank.judge(e, known)

    def judgement(self, place: int) -> Judgement | None:
        """Of one of the charts; None if it had nothing to judge."""
        return self._bank.judgement(place) if self._known[place] else None

    def restart(self, place: int) -> None:
        """Let one of the charts forget."""
        self._bank.restart(np.arange(len(self._signals)) == place)

    def explain(self, place: int, judgement: Judgement, scales: list[float], units: list[str]) -> Explanation:
        """What to say of a point that is out."""
        signal, unit = self._signals[place], units[place]
        side = "above" if judgement.statistic > judgement.centre else "below"
        size = abs(judgement.statistic) * scales[place]
        if self._name == Shewhart.name:
            allowed = format_quantity(judgement.upper_limit * scales[place], unit)
            text = f"{signal} is {format_quantity(size, unit)} {side} what the model expects (allowed: {allowed})"
        elif self._name == Ewma.name:
            # As the lasting shift of the output that would look like this.
            shift = format_quantity(size / self._passed[place], unit)
            text = f"{signal} is on average {shift} {side} what the model expects"
        else:
            text = f"{signal} has been {side} what the model expects for long"
        return Explanation(text, {signal: 1.0})


class _OfAll:
    """A chart of all outputs together.

    Args:
        chart: the chart.
        signals: names of the outputs.
        evaluated: which of them the chart looks at.
    """

    def __init__(self, chart: VectorChart, signals: tuple[str, ...], evaluated: list[bool]) -> None:
        self._chart = chart
        self._signals = tuple(compress(signals, evaluated))
        self._evaluated = None if all(evaluated) else evaluated  # None: all
        self._last: list[float] = []
        self._judgement: Judgement | None = None

    @classmethod
    def from_bytes(cls, name: str, data: bytes, signals: tuple[str, ...], evaluated: list[bool]) -> "_OfAll":
        """The chart that goes on where it was."""
        if name == Mewma.name:
            return cls(Mewma.from_state(MewmaState.from_bytes(data)), signals, evaluated)
        if name == T2.name:
            return cls(T2.from_state(T2State.from_bytes(data)), signals, evaluated)
        model = PcaModel.from_bytes(data)
        return cls(PcaT2(model) if name == PcaT2.name else PcaSpe(model), signals, evaluated)

    def to_bytes(self) -> bytes:
        """All that the chart is and remembers."""
        return self._chart.state.to_bytes()

    def update(self, e: list[float], known: list[bool], withheld: tuple[bool, ...]) -> bool:
        """Take a row in; whether the chart is out. A row in which an output is missing is left out."""
        if self._evaluated is not None:
            e, known = list(compress(e, self._evaluated)), list(compress(known, self._evaluated))
        if False in known or True in withheld:
            self._judgement = None
            return False
        self._last = e
        self._judgement = self._chart.update(e)
        return self._judgement.out

    def judgement(self, place: int) -> Judgement | None:
        """None if it had nothing to judge."""
        return self._judgement

    def restart(self, place: int) -> None:
        """Let the chart forget."""
        self._chart.restart()

    def explain(self, place: int, judgement: Judgement, scales: list[float], units: list[str]) -> Explanation:
        """What to say of a point that is out."""
        chart = self._chart
        parts = chart.contributions() if isinstance(chart, Mewma) else chart.contributions(self._last)
        shares = np.maximum(parts, 0.0) / np.sum(np.maximum(parts, 0.0))
        order = np.argsort(-shares)
        told = " and ".join(f"{self._signals[index]} ({100 * shares[index]:.0f} %)" for index in order)
        text = f"what the model leaves unexplained is unlike the training: {told}"
        return Explanation(text, {self._signals[index]: float(shares[index]) for index in order})


@dataclass
class _Watched:
    """Charts, with the alarm and the key of each."""

    charts: _OfEach | _OfAll
    alarms: list[ChartAlarm]
    keys: list[str]
    at_rest: bool = True


class ChartWatch:
    """The charts of one plant.

    Args:
        config: of the monitor.
        board: the alarms of the plant; those of the charts are declared here.
    """

    def __init__(self, config: MonitorConfig, board: Annunciator) -> None:
        self._config = config
        self._board = board
        self._alarms = {
            pair: board.declare(*pair, without_on_delay=pair[0] not in WITHOUT_MEMORY, priority=self._priority(pair[1]))
            for pair in alarm_names(config)
        }
        self._watched: dict[str, _Watched] = {}
        self._evaluated: list[bool] = []
        self._chosen: list[str] = []
        self._passed: list[float] = []
        self.widths: list[float] = []
        """Of the Shewhart limits, one an output, in standard deviations; they are shown about the predictions."""

    def _priority(self, signal: str) -> PriorityName | None:
        if signal != ALL:
            return None
        ranks: tuple[PriorityName, ...] = ("low", "medium", "high", "critical")
        return max((self._config.priorities.get(name, "medium") for name in self._config.outputs), key=ranks.index)

    def choose(self, evaluated: list[bool], e: Array) -> dict[str, str]:
        """Choose the charts that can be made; returns the others, by alarm, each with the reason.

        Args:
            evaluated: which outputs are evaluated.
            e: the training's prewhitened residuals, shape (n, outputs); NaN where there is none.
        """
        names = list[str](dict.fromkeys(chart for chart, _ in self._alarms))
        obstacles = {
            name: why
            for name in names
            if name in OF_ALL and (why := joint_obstacle(name, self._config.outputs, e, evaluated))
        }
        self._evaluated, self._chosen = evaluated, [name for name in names if name not in obstacles]
        return {self._alarms[name, ALL].name: why for name, why in obstacles.items()}

    @property
    def chance_alarms(self) -> int:
        """Number of their alarms that chance can raise."""
        return sum(sum(self._evaluated) if name in OF_EACH else 1 for name in self._chosen)

    def start(self, learned: list[Prewhitening], e: Array, arl0: float) -> None:
        """Make the charts, after `choose`.

        Args:
            learned: from the training, one an output.
            e: the training's prewhitened residuals, shape (n, outputs); NaN where there is none.
            arl0: run length of each alarm without a fault, in rows.
        """
        config = self._config
        design = ChartDesign(config, learned, e, self._evaluated, arl0)
        self.widths, self._passed = design.widths, [item.passed for item in learned]

        def made(name: str) -> _OfEach | _OfAll:
            if name in OF_EACH:
                return _OfEach(name, Bank(design.of_each(name)), config.outputs, self._passed)
            return _OfAll(design.of_all(name), config.outputs, self._evaluated)

        self._watch(made)

    @property
    def state(self) -> ChartsState:
        """A copy of all that the charts are and remember; their alarms are the board's."""
        charts = {name: watched.charts.to_bytes() for name, watched in self._watched.items()}
        return ChartsState(charts, list(self.widths), list(self._passed))

    def restore(self, state: ChartsState, evaluated: list[bool]) -> None:
        """Go on, bit for bit, where charts of the same settings were when `state` was taken; after the board.

        Args:
            state: of the other charts.
            evaluated: which outputs are evaluated.

        Raises:
            ValueError: the state is damaged.
        """
        signals = self._config.outputs
        self.widths, self._passed = list(state.widths), list(state.passed)
        names = list[str](dict.fromkeys(chart for chart, _ in self._alarms))
        self._evaluated, self._chosen = evaluated, [name for name in names if name in state.charts]
        each = {name for name in names if name in OF_EACH}
        if not each <= set(state.charts) <= set(names) or not len(self.widths) == len(self._passed) == len(signals):
            raise ValueError(f"there must be the charts {', '.join(names)}, got {', '.join(state.charts)}")

        def made(name: str) -> _OfEach | _OfAll:
            data = state.charts[name]
            if name in OF_EACH:
                return _OfEach.from_bytes(name, data, signals, self._passed)
            return _OfAll.from_bytes(name, data, signals, self._evaluated)

        self._watch(made)

    def _watch(self, made: Callable[[str], _OfEach | _OfAll]) -> None:
        """Give the charts of each name their alarms and keys."""
        self._watched = {}
        for name in self._chosen:
            pairs = [pair for pair in self._alarms if pair[0] == name]
            alarms = [self._alarms[pair] for pair in pairs]
            paths = [keys.key(self._config.plant, keys.CHART, keys.chart_name(*pair)) for pair in pairs]
            self._watched[name] = _Watched(made(name), alarms, paths, all(alarm.is_idle for alarm in alarms))

    def update(
        self,
        time_ns: int,
        e: list[float],
        withheld: tuple[bool, ...],
        scales: list[float],
        units: list[str],
        publications: list[Publication],
        *,
        points: bool,
    ) -> bool:
        """Judge a row.

        Args:
            time_ns: of the row.
            e: the prewhitened residuals; NaN where there is none.
            withheld: outputs whose value may be an outlier and must not enter a memory yet.
            scales: what one standard deviation is, in the outputs' units.
            units: of the outputs.
            publications: what is to be published is added here.
            points: whether the charts' points are to be published.

        Returns:
            Whether an alarm was raised.
        """
        raised = False
        known = [size == size for size in e]  # NaN is not equal to itself
        for watched in self._watched.values():
            out = watched.charts.update(e, known, withheld)
            if not (out or points) and watched.at_rest:
                continue
            for place, alarm in enumerate(watched.alarms):
                judgement = watched.charts.judgement(place)
                if judgement is None:
                    continue
                if points:
                    publications.append(Publication(watched.keys[place], _point(time_ns, judgement)))
                rule = alarm.memory.rule
                if judgement.out or rule.standing or rule.recent:
                    stood = rule.standing
                    explain = None if stood else _explaining(watched.charts, place, scales, units)
                    publications.extend(self._board.evaluate(alarm, time_ns, judgement, SD, explain))
                    raised |= rule.standing and not stood
                    if stood and not rule.standing:
                        watched.charts.restart(place)
            watched.at_rest = all(alarm.is_idle for alarm in watched.alarms)
        return raised


def _explaining(
    charts: _OfEach | _OfAll, place: int, scales: list[float], units: list[str]
) -> Callable[[Judgement], Explanation]:
    return lambda judgement: charts.explain(place, judgement, scales, units)


def _point(time_ns: int, judgement: Judgement) -> ChartPoint:
    return ChartPoint(
        time_ns=time_ns,
        statistic=judgement.statistic,
        centre=judgement.centre,
        lower_limit=judgement.lower_limit,
        upper_limit=judgement.upper_limit,
        out=judgement.out,
    )

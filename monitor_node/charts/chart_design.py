"""Design of a plant's charts: their alarms, those that its training allows, their rates, and their detectors."""

from collections.abc import Iterable
from itertools import compress
from math import nan

import numpy as np

from monitor_node.config import MonitorConfig
from reactorwatch.arrays import Array
from reactorwatch.contract import keys
from reactorwatch.spc import false_alarm_budget
from reactorwatch.spc.charts.base import Baseline, Chart, JointChart, SignalChart, complete_rows
from reactorwatch.spc.charts.catalogue import chart
from reactorwatch.spc.charts.level import Level
from reactorwatch.spc.charts.value_chart import ValueBaseline, ValueChart
from reactorwatch.spc.detection import Detector
from reactorwatch.spc.false_alarm_budget import TrainingErrors
from reactorwatch.spc.prewhitening import Prewhitening, memory_sds
from reactorwatch.spc.run_length import false_alarm_rates

ALL = "all"
"""Name in place of a signal for charts of all outputs together."""

SUBSTITUTES = ("shewhart", "ewma")
"""Charts of each output that are made where the settings have charts of values only, and none of them can be made."""


def alarm_names(config: MonitorConfig) -> list[tuple[str, str]]:
    """(chart, signal or `ALL`) of every alarm that the charts of a plant can raise."""
    names: list[tuple[str, str]] = []
    for name in config.charts:
        kind = chart(name)
        if issubclass(kind, SignalChart):
            names += [(name, signal) for signal in config.outputs]
        elif issubclass(kind, ValueChart) or (issubclass(kind, JointChart) and len(config.outputs) > 1):
            names.append((name, ALL))
    if config.has_values_only:
        names += [(name, signal) for name in SUBSTITUTES for signal in config.outputs]
    return names


def count_chance_alarms(config: MonitorConfig) -> int:
    """Number of the charts' alarms that share the false alarms, with every signal monitored; see `ValueChart`."""
    return _count_alarms(dict.fromkeys(config.charts), len(config.outputs), len(config.signals))


def _count_alarms(names: Iterable[str], outputs: int, signals: int) -> int:
    """Number of alarms of charts by name, of so many outputs, and of the signals of charts of values."""
    kinds = [chart(name) for name in names]
    joint = sum(issubclass(kind, JointChart) for kind in kinds) if outputs > 1 else 0
    of_each = outputs * sum(issubclass(kind, SignalChart) for kind in kinds)
    of_values = sum(outputs if kind.is_of_outputs else signals for kind in kinds if issubclass(kind, ValueChart))
    return joint + of_each + of_values


class ChartDesign:
    """Design of the charts of one plant.

    Attributes:
        names: charts of the settings, and those that may take their place.
        chosen: charts that are made, by name.
        evaluated: for each output, True if it is evaluated.
        signals: signals of the charts of values.
        is_identified: True if identified models predict.
        memory_shares: share of the training's residuals that charts with a memory take, shape (n,).
    """

    def __init__(self, config: MonitorConfig) -> None:
        self._config, self.is_identified, self.memory_shares = config, False, np.ones(1)
        self.names = list[str](dict.fromkeys(name for name, _ in alarm_names(config)))
        self.chosen: list[str] = []
        self.evaluated: list[bool] = []
        self.signals: tuple[str, ...] = ()

    def choose(self, evaluated: list[bool], e: Array, values: Array, *, has_equations: bool) -> dict[str, str]:
        """Choose the charts that can be made; returns the others, by alarm, each with the reason.

        Args:
            evaluated: for each output, True if it is evaluated.
            e: the training's prewhitened residuals, shape (n, outputs); NaN where there is none.
            values: its measured values, shape (n, signals), the inputs first; NaN where missing, for each row of a
                signal that is left out.
            has_equations: True if equations predict: they know how far an input moves the outputs, and where that is
                not in proportion, so slow changes are those of their residuals. `level` is then made alone only.
        """
        rows = complete_rows(e, np.flatnonzero(evaluated).tolist())
        signals = list(compress(self._config.outputs, evaluated))
        obstacles = {
            name: why
            for name in self.names
            if issubclass(kind := chart(name), JointChart) and (why := kind.obstacle(rows, signals))
        }
        baseline = self.value_baseline(values, nan)
        self.signals = baseline.names
        obstacles |= {
            name: why
            for name in self.names
            if issubclass(kind := chart(name), ValueChart) and (why := kind.obstacle(baseline))
        }
        charts = [name for name in dict.fromkeys(self._config.charts) if name in self.names and name not in obstacles]
        if has_equations and self._config.inputs and set(charts) - {Level.name}:
            charts = [name for name in charts if name != Level.name]
        if not set(charts) - {Level.name} and len(charts) < len(self._config.charts):  # it sees slow changes only
            charts = [name for name in self.names if name not in obstacles]
        self.evaluated, self.chosen = evaluated, charts
        return {keys.chart_name(name, ALL): why for name, why in obstacles.items()}

    @property
    def alarms_of_each(self) -> dict[str, int]:
        """Number of alarms of each of the chosen charts that chance can raise, by name."""
        return {name: _count_alarms([name], sum(self.evaluated), len(self.signals)) for name in self.chosen}

    @property
    def chance_alarms(self) -> int:
        """Number of alarms of the chosen charts that chance can raise."""
        return sum(self.alarms_of_each.values())

    def _complete_values(self, values: Array) -> tuple[tuple[str, ...], Array]:
        """Names of the signals with values that vary, and the rows in which none of them is missing."""
        indices = np.flatnonzero(np.isfinite(values).any(axis=0))
        complete = complete_rows(values, indices.tolist())
        varies = np.ptp(complete, axis=0) > 0.0 if len(complete) else np.ones(indices.size, np.bool_)
        names = tuple(self._config.signals[index] for index in indices[varies].tolist())
        return names, complete[:, varies]

    def baselines(self, learned: list[Prewhitening], e: Array, arl0: float) -> dict[bool, Baseline]:
        """Baseline of charts of residuals, by whether they have a memory; arguments as for `relative_rates`."""
        config = self._config
        p = false_alarm_budget.point_probability(arl0, config.raise_count, config.window)
        lasting = e * self.memory_shares[:, None]
        sds = memory_sds(lasting, config.chart_settings["ewma_weight"], 0.0 if self.is_identified else 3.0)
        taken = {False: e, True: lasting}
        return {has: Baseline(tuple(learned), x, sds, arl0, p, config.chart_settings) for has, x in taken.items()}

    def value_baseline(self, values: Array, arl0: float) -> ValueBaseline:
        """Baseline of charts of values; arguments as for `relative_rates`."""
        config, (names, complete) = self._config, self._complete_values(values)
        inputs = sum(name in config.inputs for name in names)
        return ValueBaseline(names, complete, arl0, config.chart_settings, config.chart_signals, inputs)

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
        baselines = self.baselines(learned, e, arl0)
        total = np.zeros(len(errors.mean))
        for name in self.chosen:
            kind = chart(name)
            if issubclass(kind, ValueChart):
                total += kind.relative_rates(self.value_baseline(values, arl0))
                continue
            assert issubclass(kind, SignalChart | JointChart)
            baseline = baselines[kind.has_memory]
            for group in self._groups(kind):
                rates = kind.relative_rates(baseline.of(group), errors.of(group))
                total += rates if kind.has_memory else self._rule_rates(baseline, rates)
        return total

    def detectors(self, learned: list[Prewhitening], e: Array, arl0: float) -> list[Detector]:
        """The charts as moving averages, as far as they are; arguments as for `relative_rates`."""
        baselines, found = self.baselines(learned, e, arl0), list[Detector]()
        for name in self.chosen:
            kind = chart(name)
            for group in self._groups(kind):
                average = kind.detector(baselines[kind.has_memory].of(group))
                if average is not None:
                    weight, level, matrix = average
                    rule = (1, 1) if kind.has_memory else (self._config.raise_count, self._config.window)
                    found.append(Detector(tuple(group), matrix, weight, level, rule))
        return found

    def level_reaches(self, values: Array, arl0: float) -> dict[str, float]:
        """See `Level.reaches`; empty without this chart. Arguments as for `relative_rates`."""
        return Level.reaches(self.value_baseline(values, arl0)) if Level.name in self.chosen else {}

    def _groups(self, kind: type[Chart]) -> list[list[int]]:
        """Indices of the outputs of each chart of a kind."""
        evaluated: list[int] = np.flatnonzero(self.evaluated).tolist()
        return [[index] for index in evaluated] if issubclass(kind, SignalChart) else [evaluated]

    def _rule_rates(self, baseline: Baseline, rates: Array) -> Array:
        """Relative rate of an alarm that takes several points, from that of single points."""
        count, window, p = self._config.raise_count, self._config.window, baseline.point_probability
        nodes = np.geomspace(0.1 * p, 1.0, 40)  # rates of far rarer points are rounding errors, and nothing
        of_rule = np.maximum(false_alarm_rates(count, window, nodes) * baseline.arl0, 1e-9)
        return np.asarray(np.exp(np.interp(np.log(np.maximum(rates * p, nodes[0])), np.log(nodes), np.log(of_rule))))

"""Slow deviations: lasting steps of measurements, changes in an incident, drift of the models from the references.

Where a reference predicts an output from its last values, as the ARX models and the black box do, a lasting step is in
the residual for a few rows only. The test (`reactorwatch.spc.step_test`) finds it by the form of these rows and tells
it from an outlier. The equations follow no measurement against their balances: with them there is no such test, and no
share of the promised false alarms. Rows in which the reference extrapolates are tested all the same: a step in them
would not be seen afterwards, as the reference follows it, or learns it.

Where nothing moves the plant but itself, as there are no inputs, a change of its level while an alarm is active is an
event of its own: it returns, or goes on to another state (`reactorwatch.spc.level_change`).

Drift is published every few minutes. By default it raises no alarm: a plant that is run where it was not run in
training drifts from its linear model without anything being wrong. With `parameters` among the charts it raises one,
with its share of the budget of false alarms.
"""

from collections.abc import Iterator
from itertools import compress
from math import isfinite, nan

import numpy as np

from monitor_node.alarms.alarms import AlarmChange, ChartAlarm
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.charts.chart_design import ALL
from monitor_node.charts.charts import chart_point
from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import MeasuredRow
from monitor_node.learn.arx import JUDGING_FORGETTING, ArxPredictor, arx_structure, judging_structures
from monitor_node.learn.arx_fit import start_drift_chart
from reactorwatch.arrays import Array
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import Judgement, format_quantity
from reactorwatch.spc.charts.parameters import ParameterT2, adaptive_weight, prepare_limit
from reactorwatch.spc.level_change import LevelChange
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.step_test import ONSETS, STEP_TEST, StepTests
from reactorwatch.stored_state import Records, place_records

NAME = "shift"
"""Name of the chart."""

STAYED = "stayed there, which the model follows from then on"
"""End of an alarm's text."""


class ShiftWatch:
    """Tests the outputs of a plant for lasting steps."""

    def __init__(self, config: MonitorConfig, board: Annunciator) -> None:
        self._outputs, self._board = config.outputs, board
        self._alarms = [board.declare(NAME, signal, without_on_delay=True) for signal in self._outputs]
        self._keys = [keys.key(config.plant, keys.CHART, keys.chart_name(NAME, item)) for item in self._outputs]
        self._tests: StepTests | None = None
        self._none = [nan] * len(self._outputs)
        self.is_active = False
        """True if there are tests, which share the promised false alarms."""

    def start(self, responses: Array | None, z: Array, learned: list[Prewhitening], arl0: float) -> None:
        """Learn the tests from a training.

        Args:
            responses: response of each output's residual to a lasting step of one unit, shape (outputs, rows); NaN for
                an output without one; None: the reference does not follow a step.
            z: residuals of the training, shape (rows, outputs); NaN where there is none.
            learned: prewhitening of each residual.
            arl0: run length of each alarm without a fault, in rows.
        """
        self._tests = None if responses is None else StepTests.learn(responses, z, learned, arl0)
        self.is_active = self._tests is not None

    @property
    def memory(self) -> Records | None:
        """Numbers of the tests; None without tests. The alarms belong to the board."""
        return None if self._tests is None else self._tests.numbers

    def resume(self, memory: Records | None) -> None:
        """Go on from a memory; after the board.

        Raises:
            ValueError: the memory is of other outputs.
        """
        numbers = None if memory is None else place_records(memory, np.zeros(len(self._outputs), STEP_TEST))
        self._tests = None if numbers is None else StepTests(numbers)
        self.is_active = self._tests is not None

    @property
    def sensitivities(self) -> list[tuple[float, float]]:
        """Statistic of each output's test after a lasting step of one unit, and its limit; empty without tests."""
        tests = self._tests
        return [] if tests is None else [(tests.sensitivity(i), tests.limit(i)) for i in range(len(self._outputs))]

    def restart(self) -> None:
        """Forget the rows seen, after a gap."""
        if self._tests is not None:
            self._tests.restart()

    def update(self, row: MeasuredRow, z: list[float], *, away: list[bool], points: bool) -> list[AlarmChange]:
        """Test a row; returns the changes of alarms. For `away` see `ChartWatch.update`."""
        changes: list[AlarmChange] = []
        if self._tests is None:
            return changes
        for _ in range(min(row.interval.missing, ONSETS)):
            self._tests.update(self._none)
        is_out = self._tests.update(z)
        if not (is_out or points or any(alarm.memory.standing or alarm.memory.recent for alarm in self._alarms)):
            return changes
        for i, alarm in enumerate(self._alarms):
            point = self._tests.point(i)
            if not isfinite(point.statistic):
                continue
            judgement = Judgement(point.statistic, 0.0, -point.limit, point.limit, abs(point.statistic) > point.limit)
            if points:
                row.publications.append(Publication(self._keys[i], chart_point(row.time_ns, judgement)))
            if (change := alarm.update(judgement, "sd", away=away[i])) is None:
                continue
            name, step = self._outputs[i], format_quantity(point.size, row.units[i], "+.3g")
            change.text = f"{name} moved by {step} {point.rows} rows before and {STAYED}"
            change.contributions = {name: 1.0}
            changes.append(change)
        return changes


CHANGE = "change"
"""Name of the chart of changes within an incident."""


class ChangeWatch:
    """Tests a plant without inputs for changes of level while an alarm without a known cause is active.

    Attributes:
        memory: the test; None with inputs, and before the end of the training.
    """

    def __init__(self, config: MonitorConfig, board: Annunciator) -> None:
        self._outputs, self._rows = config.outputs, config.clear_count  # what ends an alarm lasts
        self._alarm: ChartAlarm | None = None
        if not config.inputs:
            # a change in an incident belongs to it, and says nothing of its cause
            self._alarm = board.declare(CHANGE, ALL, without_on_delay=True, without_off_delay=True, is_transient=True)
        self._key = keys.key(config.plant, keys.CHART, keys.chart_name(CHANGE, ALL))
        self.memory: LevelChange | None = None

    def start(self, values: Array) -> None:
        """Learn from the outputs of a training, shape (rows, outputs); NaN where missing or disturbed."""
        self.memory = None if self._alarm is None else LevelChange.learn(values, self._rows)

    def restart(self) -> None:
        """Forget the rows seen, after a gap."""
        if self.memory is not None:
            self.memory.restart()

    def end_incident(self) -> None:
        """Wait for the next incident."""
        if self.memory is not None:
            self.memory.start()

    def update(self, row: MeasuredRow, *, points: bool) -> list[AlarmChange]:
        """Test a row of an incident; returns the change of the alarm."""
        test, alarm = self.memory, self._alarm
        if test is None or alarm is None:
            return []
        changes = test.update(list(row.values))
        if len(test.recent) < 2 * test.rows:
            return []
        shares = [abs(change) / limit for change, limit in zip(changes, test.limits, strict=True)]
        largest = max(shares)
        is_out = largest > 1.0
        test.is_settled |= not is_out
        judgement = Judgement(largest, 0.0, 0.0, 1.0, is_out and test.is_settled)
        if points:
            row.publications.append(Publication(self._key, chart_point(row.time_ns, judgement)))
        if (found := alarm.update(judgement)) is None:
            return []
        order = sorted(range(len(shares)), key=lambda i: -shares[i])
        total = sum(share * share for share in shares) or 1.0
        found.contributions = {self._outputs[i]: shares[i] ** 2 / total for i in order}
        first = order[0]
        moved = format_quantity(changes[first], row.units[first], "+.3g")
        found.text = f"the plant moves again: {self._outputs[first]} by {moved} within {test.rows} rows"
        return [found]


ROWS = 50
"""Rows from one evaluation to the next. The models remember hundreds of rows, so nothing is missed between."""


def preparation(config: MonitorConfig, *, wanted: bool) -> Iterator[None]:
    """Compute what the limits take seconds for, step by step: no row waits for it at the end of the training."""
    if not (wanted or ParameterT2.name in config.charts):
        return
    # The adaptive models have a longer memory, and other orders, where they judge; the training decides whether they do
    # if the settings do not.
    beside = [(arx_structure(config).parameters, config.forgetting)]
    forgetting = max(config.forgetting, JUDGING_FORGETTING)
    judging = [(structure.parameters, forgetting) for structure in judging_structures(config)]
    for parameters, memory in {"arx": judging, "auto": beside + judging}.get(config.reference, beside):
        yield from prepare_limit(parameters, adaptive_weight(memory))


class DriftWatch:
    """Compares the models of a plant."""

    def __init__(self, config: MonitorConfig, board: Annunciator, *, publish: bool) -> None:
        self._outputs = config.outputs
        self._board = board
        self._alarms = {
            signal: board.declare(
                ParameterT2.name,
                signal,
                without_on_delay=True,
                without_off_delay=True,
                priority="low",
                dead_band=0.5,
            )
            for signal in self._outputs
            if ParameterT2.name in config.charts
        }
        self._publish = publish
        self._keys = [
            keys.key(config.plant, keys.CHART, keys.chart_name(ParameterT2.name, signal)) for signal in self._outputs
        ]
        self.until_next = ROWS
        """Rows until the next evaluation: the full state."""
        self.wanted = publish or bool(self._alarms)
        """True if the models have to adapt at all."""

    def chance_alarms(self, evaluated: list[bool]) -> int:
        """Number of its alarms that chance can raise."""
        return sum(evaluated) if self._alarms else 0

    def start(self, predictors: list[ArxPredictor], evaluated: list[bool], arl0: float) -> list[str]:
        """Start the comparison; returns a note for each output where that is not possible.

        Args:
            predictors: predictors of the outputs, with references.
            evaluated: for each output, True if it is evaluated.
            arl0: run length of each alarm without a fault, in rows.
        """
        notes: list[str] = []
        self.until_next = ROWS
        if not self.wanted:
            return notes
        for signal, predictor in compress(zip(self._outputs, predictors, strict=True), evaluated):
            try:
                start_drift_chart(predictor, arl0)
            except InputError as error:
                notes.append(f"the drift of {signal} is not watched: {error}")
        return notes

    def update(self, row: MeasuredRow, predictors: list[ArxPredictor]) -> list[AlarmChange]:
        """Evaluate the drift, if it is time; returns the changes of alarms."""
        changes: list[AlarmChange] = []
        if not self.wanted:
            return changes
        self.until_next -= 1
        if self.until_next:
            return changes
        self.until_next = ROWS
        for signal, predictor, key in zip(self._outputs, predictors, self._keys, strict=True):
            found = predictor.drift()
            if found is None:
                continue
            judgement, parts = found
            if self._publish:
                row.publications.append(Publication(key, chart_point(row.time_ns, judgement)))
            alarm = self._alarms.get(signal)
            if alarm is not None and (change := alarm.update(judgement)) is not None:
                largest = " and ".join(sorted(parts, key=lambda name: -parts[name])[:2])
                change.text = f"the model of {signal} that adapts has drifted from its reference, most in {largest}"
                change.contributions = {signal: 1.0}
                changes.append(change)
        return changes

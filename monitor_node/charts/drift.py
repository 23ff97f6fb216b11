"""Drift: distance of the adaptive models from the references, published every few minutes.

By default it raises no alarm: a plant that is run where it was not run in training drifts from its linear model
without anything being wrong. With `parameters` among the charts it raises one, with its share of the budget of false
alarms.
"""

from collections.abc import Iterator
from itertools import compress

from monitor_node.alarms.alarms import AlarmChange
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.charts.charts import chart_point
from monitor_node.config import MonitorConfig
from monitor_node.ingest.rows import MeasuredRow
from monitor_node.learn.arx import JUDGING_FORGETTING, ArxPredictor, arx_structure
from monitor_node.learn.arx_fit import start_drift_chart
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.parameters import ParameterT2, adaptive_weight, prepare_limit

ROWS = 50
"""Rows from one evaluation to the next. The models remember hundreds of rows, so nothing is missed between."""

DEAD_BAND = 0.5
"""The statistic moves slowly and would come back again and again from just below the limit."""

NAMED = 2
"""Parameters that the alarm names."""


def preparation(config: MonitorConfig, *, wanted: bool) -> Iterator[None]:
    """Compute what the limits take seconds for, step by step, so that no row waits for it at the end of the training.

    Args:
        config: settings of the monitor.
        wanted: the drift is published; without, it has limits only where it raises an alarm.
    """
    if not (wanted or ParameterT2.name in config.charts):
        return
    memory, judging = config.forgetting, max(config.forgetting, JUDGING_FORGETTING)
    # The adaptive models have a longer memory where they judge, which the training decides if the settings do not.
    memories = {"arx": [judging], "auto": [memory, judging]}.get(config.reference, [memory])
    for forgetting in dict.fromkeys(memories):
        yield from prepare_limit(arx_structure(config).parameters, adaptive_weight(forgetting))


class DriftWatch:
    """Compares the models of a plant.

    Args:
        config: configuration of the monitor.
        board: the alarms of the plant; those of the drift, if wanted, are declared here.
        publish: whether the drift is to be published.
    """

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
                dead_band=DEAD_BAND,
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
        """Number of its alarms that chance can raise.

        Args:
            evaluated: for each output, True if it is evaluated.
        """
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
        """Evaluate the drift, if it is time; returns the changes of alarms.

        Args:
            row: the row; points are added to its publications.
            predictors: the predictors given to `start`.
        """
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
                largest = " and ".join(sorted(parts, key=lambda name: -parts[name])[:NAMED])
                change.text = f"the model of {signal} that adapts has drifted from its reference, most in {largest}"
                change.contributions = {signal: 1.0}
                changes.append(change)
        return changes

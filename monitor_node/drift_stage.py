"""Drift: how far the models that adapt have gone from the references, told every few minutes.

It is told, and by default no alarm: a plant that is run where it was not run in training drifts from its linear model
without anything being wrong. Who wants an alarm of it puts `parameters` among the charts; it then has its share of the
budget of false alarms.
"""

from collections.abc import Callable
from itertools import compress

from monitor_node.alarms.alarms import Explanation, chart_point
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.baseline.predictor import ArxPredictor
from monitor_node.config import MonitorConfig
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.spc.charts.parameters import ParameterT2

ROWS = 50
"""From one look to the next. The models remember hundreds of rows, so nothing is missed between."""

DEAD_BAND = 0.5
"""The statistic moves slowly and would come back again and again from just below the limit."""

NAMED = 2
"""Parameters that the alarm names."""


class DriftWatch:
    """Compares the models of a plant.

    Args:
        config: of the monitor.
        board: the alarms of the plant; those of the drift, if wanted, are declared here.
        told: whether the drift is to be published.
    """

    def __init__(self, config: MonitorConfig, board: Annunciator, *, told: bool) -> None:
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
        self._told = told
        self._keys = [
            keys.key(config.plant, keys.CHART, keys.chart_name(ParameterT2.name, signal)) for signal in self._outputs
        ]
        self.until_next = ROWS
        """Rows until the next look: all that is remembered here."""
        self.wanted = told or bool(self._alarms)
        """Whether the models have to adapt at all."""

    def chance_alarms(self, evaluated: list[bool]) -> int:
        """Number of its alarms that chance can raise.

        Args:
            evaluated: which outputs are evaluated.
        """
        return sum(evaluated) if self._alarms else 0

    def start(self, predictors: list[ArxPredictor], evaluated: list[bool], arl0: float) -> list[str]:
        """Begin to compare; returns what people are to be told where that is not possible.

        Args:
            predictors: one an output, with references.
            evaluated: which outputs are evaluated.
            arl0: run length of each alarm without a fault, in rows.
        """
        notes: list[str] = []
        if not self.wanted:
            return notes
        for signal, predictor in compress(zip(self._outputs, predictors, strict=True), evaluated):
            try:
                predictor.start_drift_chart(arl0)
            except InputError as error:
                notes.append(f"the drift of {signal} is not watched: {error}")
        return notes

    def update(self, time_ns: int, predictors: list[ArxPredictor]) -> list[Publication]:
        """Compare, if it is time; to be called only if `wanted`.

        Args:
            time_ns: of the row.
            predictors: as at the start.
        """
        self.until_next -= 1
        if self.until_next:
            return []
        self.until_next = ROWS
        publications: list[Publication] = []
        for signal, predictor, key in zip(self._outputs, predictors, self._keys, strict=True):
            found = predictor.drift()
            if found is None:
                continue
            judgement, parts = found
            if self._told:
                publications.append(Publication(key, chart_point(time_ns, judgement)))
            if signal in self._alarms:
                explain = _explaining(signal, parts)
                publications += self._board.evaluate(self._alarms[signal], time_ns, judgement, "", explain)
        return publications


def _explaining(signal: str, parts: dict[str, float]) -> Callable[[Judgement], Explanation]:
    largest = sorted(parts, key=lambda name: -parts[name])[:NAMED]
    text = f"the model of {signal} that adapts has drifted from its reference, most in {' and '.join(largest)}"
    return lambda _: Explanation(text, {signal: 1.0})

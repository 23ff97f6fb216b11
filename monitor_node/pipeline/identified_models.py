"""Identified models of a plant: one an output, which predict each row and are updated with it.

Where they do not judge, they keep adapting beside the reference, and their predictions are published beside its own.
Where rows of many signals need predictions for the signal checks only, a bank of the fitted models makes them.
"""

from collections.abc import Sequence

import numpy as np

from monitor_node.baseline.arx_bank import ArxBank, ArxBankState
from monitor_node.baseline.arx_fit import arx_structure
from monitor_node.baseline.arx_reference import ArxReference
from monitor_node.baseline.predictor import ArxPredictor, PredictorState
from monitor_node.baseline.references import Reference
from monitor_node.baseline.training_rows import TrainingState
from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import MeasuredRow
from monitor_node.pipeline.estimates import estimates
from monitor_node.stages.chart_alarms import has_values_only
from reactorwatch.contract import keys
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import unpack_numbers, unpack_times


class IdentifiedModels:
    """Identified models of one plant.

    Args:
        config: settings of the monitor.
        points: True to publish predictions; False: rows are buffered where nothing needs a prediction.

    Attributes:
        points: see above.
        paths: key of each output's estimate.
        predictors: the models, one an output.
        bank: the fitted models in one call; None where the adaptive ones predict.
    """

    def __init__(self, config: MonitorConfig, *, points: bool) -> None:
        self._config, self.points = config, points
        self.paths = [keys.key(config.plant, keys.ESTIMATE, signal) for signal in config.outputs]
        self._paths_beside = [f"{path}/{ArxReference.kind}" for path in self.paths]
        self.restart()

    def restart(self) -> None:
        """Start models that know nothing."""
        structure, forgetting = arx_structure(self._config), self._config.forgetting
        self.predictors = [
            ArxPredictor(structure, forgetting, with_snapshots=self.points) for _ in self._config.outputs
        ]
        self.bank: ArxBank | None = None

    @property
    def state(self) -> list[PredictorState]:
        """A copy of the models' state, without the bank."""
        return [predictor.state for predictor in self.predictors]

    def restore(self, state: Sequence[PredictorState]) -> None:
        """Resume bit-identically from `state`."""
        for predictor, item in zip(self.predictors, state, strict=True):
            predictor.restore(item)

    def resume(self, state: Sequence[PredictorState]) -> None:
        """Resume from `state` with a row that does not follow the ones before."""
        self.restore(state)
        for predictor in self.predictors:
            predictor.restart()

    def learn_again(self, rows: TrainingState) -> None:
        """Learn from the rows of a training."""
        inputs, time_min = len(self._config.inputs), np.array(unpack_times(rows.times_ns)) / MINUTE_NS
        columns = unpack_numbers(rows.rows, len(self._config.signals))
        for index, predictor in enumerate(self.predictors):
            predictor.learn_again(time_min, columns[:, :inputs], columns[:, inputs + index])

    def use_bank(self, reference: Reference) -> None:
        """Make the bank, if there is to be one with this reference."""
        has_bank = isinstance(reference, ArxReference) and has_values_only(self._config)
        self.bank = ArxBank(self.predictors, len(self._config.inputs)) if has_bank else None

    def restore_bank(self, state: ArxBankState | None) -> None:
        """Resume the bank, if there is one, from its state.

        Raises:
            ValueError: the state is missing, or of other models.
        """
        if self.bank is None:
            return
        if state is None:
            raise ValueError("the state of a plant of many signals must have that of its models")
        self.bank.restore(state)

    def start_judging(self) -> None:
        """Judge rows from now on by the adaptive models, unless a bank does."""
        for predictor in () if has_values_only(self._config) else self.predictors:
            predictor.start_judging()

    @property
    def judges(self) -> bool:
        """True if rows are judged by the adaptive models."""
        return any(predictor.judges for predictor in self.predictors)

    def set_learning(self, learning: bool) -> None:
        """Let adaptive models that judge learn, or not."""
        for predictor in () if self.bank is not None else self.predictors:
            predictor.set_learning(learning)

    def update(self, row: MeasuredRow, *, beside: bool) -> None:
        """Update with a row that is not judged by these models; publish their predictions.

        Args:
            row: the row; estimates are added to its publications.
            beside: True beside the reference, False during the training.
        """
        if self.points:
            row.publications.extend(estimates(row, self._paths_beside if beside else self.paths, self._predict(row)))
        else:
            self._buffer(row)

    def predict(self, row: MeasuredRow, *, adapts: bool) -> list[float]:
        """Predict each output of a row, then update with it.

        Args:
            row: the row.
            adapts: True if the adaptive models are updated where a bank predicts.
        """
        if self.bank is None:
            return self._predict(row)
        if adapts:
            self._buffer(row)
        return self.bank.predict(row.inputs, row.values, follows=row.follows)

    def _predict(self, row: MeasuredRow) -> list[float]:
        return [
            predictor.update(row.time_ns, row.inputs, value, follows=row.follows)
            for predictor, value in zip(self.predictors, row.values, strict=True)
        ]

    def _buffer(self, row: MeasuredRow) -> None:
        """Buffer a row, whose predictions nothing needs now."""
        for predictor, value in zip(self.predictors, row.values, strict=True):
            predictor.buffer(row.time_ns, row.inputs, value, follows=row.follows)

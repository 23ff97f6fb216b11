"""Messages about predictions: estimates of a row, and snapshots of the models that made them."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import repeat
from math import isfinite, nan

from monitor_node.baseline.arx_reference import ArxReference
from monitor_node.baseline.black_box_reference import BlackBoxReference
from monitor_node.baseline.predictor import ArxPredictor
from monitor_node.baseline.process_reference import ProcessReference
from monitor_node.baseline.references import Reference
from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import MeasuredRow
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Check, Estimate, ModelSnapshot, Parameter

NO_LIMITS = 0.0, nan, nan


def estimates(
    row: MeasuredRow,
    paths: Sequence[str],
    predictions: Sequence[float],
    limits: Iterable[tuple[float, float, float]] | None = None,
) -> Iterator[Publication]:
    """Estimates of a row's outputs that have a value and a prediction.

    Args:
        row: the row.
        paths: key of each output's estimate.
        predictions: prediction of each output.
        limits: standard deviation of each residual, and the lower and upper limit of the value; None: not learned yet.
    """
    of_outputs = zip(paths, predictions, row.values, row.units, strict=True)
    for (path, prediction, value, unit), (sd, lower, upper) in zip(
        of_outputs, limits or repeat(NO_LIMITS), strict=False
    ):
        residual = value - prediction
        if isfinite(residual):
            estimate = Estimate(time_ns=row.time_ns, prediction=prediction, residual=residual, unit=unit)
            estimate.residual_sd, estimate.lower_limit, estimate.upper_limit = sd, lower, upper
            yield Publication(path, estimate)


def chart_limits(
    predictions: Sequence[float],
    sds: Sequence[float],
    scales: Sequence[float],
    expected: Sequence[float],
    widths: Sequence[float],
) -> Iterator[tuple[float, float, float]]:
    """Standard deviation of each residual, and limits about the value that the prewhitening filter expects.

    Args:
        predictions: prediction of each output.
        sds: standard deviation of each prediction error.
        scales: standard deviation of each prewhitened residual in the output's unit.
        expected: residual that the prewhitening filter expects, in standard deviations.
        widths: Shewhart limit of each output, in standard deviations.
    """
    for prediction, sd, scale, mean, width in zip(predictions, sds, scales, expected, widths, strict=True):
        usual, reach = prediction + sd * mean, scale * width
        yield scale, usual - reach, usual + reach


def model_snapshots(
    config: MonitorConfig, predictors: Sequence[ArxPredictor], reference: Reference | None, checks: Sequence[Check]
) -> Iterator[list[ModelSnapshot]]:
    """Snapshots of each output's models: adaptive, fitted to the training, and the reference.

    The fitted model is only compared with the adaptive one, which is the reference if that is `arx`.

    Args:
        config: settings of the monitor.
        predictors: identified models, one an output.
        reference: the reference; None during the training.
        checks: checks of the training.
    """
    for index, (output, predictor) in enumerate(zip(config.outputs, predictors, strict=True)):
        adaptive, fitted = predictor.adaptive_snapshot(), predictor.reference_snapshot()
        judging = _filter_snapshot(reference, output) if isinstance(reference, ProcessReference) else None
        if isinstance(reference, BlackBoxReference):
            judging = reference.snapshot(index, config.inputs, config.outputs)
        if fitted is not None:
            fitted.held = True
        if adaptive is not None:
            adaptive.reference = isinstance(reference, ArxReference)
        for snapshot in (adaptive if predictor.judges else fitted, judging):
            if snapshot is not None:
                snapshot.checks.extend(checks)
        yield [snapshot for snapshot in (adaptive, fitted, judging) if snapshot is not None]


def _filter_snapshot(reference: ProcessReference, output: str) -> ModelSnapshot:
    """Snapshot of the equations' filter as reference of an output: its noise levels."""
    levels = reference.noise_levels
    sensor = Parameter(name="sensor_sd", value=levels["sensors"][output])
    states = [Parameter(name=f"{name}_sd", value=value) for name, value in levels["states"].items()]
    return ModelSnapshot(structure=reference.kind, parameters=[sensor, *states], reference=True, held=True)

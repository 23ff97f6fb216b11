"""Messages about predictions: estimates of a row, and snapshots of the models that made them."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import repeat
from math import isfinite, nan

from monitor_node.config import MonitorConfig
from monitor_node.ingest.rows import MeasuredRow
from monitor_node.learn.arx import ArxPredictor
from monitor_node.learn.arx_fit import adaptive_snapshot
from monitor_node.learn.references import Reference
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Check, Estimate, ModelSnapshot

NO_LIMITS = 0.0, nan, nan


def estimate_keys(config: MonitorConfig, beside: str = "") -> list[str]:
    """Key of each output's estimate.

    Args:
        config: settings of the monitor.
        beside: kind of the models, where they predict beside the reference.
    """
    paths = [keys.key(config.plant, keys.ESTIMATE, signal) for signal in config.outputs]
    return [f"{path}/{beside}" for path in paths] if beside else paths


def estimates(
    row: MeasuredRow,
    paths: Sequence[str],
    predictions: Sequence[float],
    limits: Iterable[tuple[float, float, float]] | None = None,
) -> list[Publication]:
    """Estimates of a row's outputs that have a value and a prediction.

    Args:
        row: the row.
        paths: key of each output's estimate.
        predictions: prediction of each output.
        limits: standard deviation of each residual, and the lower and upper limit of the value; None: not learned yet.
    """
    of_outputs, publications = zip(paths, predictions, row.values, row.units, strict=True), list[Publication]()
    for (sd, lower, upper), (path, prediction, value, unit) in zip(
        limits or repeat(NO_LIMITS), of_outputs, strict=False
    ):
        residual = value - prediction
        if isfinite(residual):
            estimate = Estimate(time_ns=row.time_ns, prediction=prediction, residual=residual, unit=unit)
            estimate.residual_sd, estimate.lower_limit, estimate.upper_limit = sd, lower, upper
            publications.append(Publication(path, estimate))
    return publications


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
    time_ns: int,
    config: MonitorConfig,
    predictors: Sequence[ArxPredictor],
    reference: Reference | None,
    checks: Sequence[Check],
) -> Iterator[Publication]:
    """Snapshots of each output's models: adaptive, fitted to the training, and the reference.

    The fitted model is only compared with the adaptive one, which is the reference if that is `arx`.

    Args:
        time_ns: time of the row.
        config: settings of the monitor.
        predictors: identified models, one an output.
        reference: the reference; None during the training.
        checks: checks of the training.
    """
    for index, (signal, predictor) in enumerate(zip(config.outputs, predictors, strict=True)):
        adaptive, stored = adaptive_snapshot(predictor), predictor.reference_model
        fitted = ModelSnapshot.FromString(stored) if stored else None
        judging = None if reference is None else reference.snapshot(index, config.inputs, config.outputs)
        if fitted is not None:
            fitted.held = True
        if adaptive is not None:
            adaptive.reference = reference is not None and reference.is_identified
        for snapshot in (adaptive if predictor.judges else fitted, judging):
            if snapshot is not None:
                snapshot.checks.extend(checks)
        for snapshot in (adaptive, fitted, judging):
            if snapshot is not None:
                snapshot.time_ns = time_ns
                yield Publication(keys.key(config.plant, keys.MODEL, signal), snapshot)

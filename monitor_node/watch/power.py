"""Power of a plant's watch: the sizes of deviations that would be seen in time, from the training and its noise.

What a deviation of unit size does to the prewhitened residuals is computed along the training, after several onsets:

- With equations, of the causes to which alarms are traced (`isolation.causes`), by the error equations of the filter
  (`diagnosis.fitting.signatures`), to first order.
- Without, of a bias of each output: for a black box the difference of two runs of its filter, for ARX models their
  lags.

Then the charts' chance to raise an alarm follows (`reactorwatch.spc.detection`).
"""

from collections.abc import Sequence
from dataclasses import replace
from math import isfinite
from typing import NamedTuple

import numpy as np

from monitor_node.causes.isolation import causes_of
from monitor_node.causes.scan import GlrScan
from monitor_node.causes.stage import has_causes
from monitor_node.causes.window import window_of
from monitor_node.config import MonitorConfig
from monitor_node.learn.process_reference import model_outputs, output_indices
from monitor_node.learn.references import Reference
from monitor_node.learn.training_rows import RowArrays, TrainingRows
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import Power
from reactorwatch.diagnosis.fitting.signatures import forward_signatures
from reactorwatch.kalman.ekf import Filter
from reactorwatch.spc.detection import Detector, smallest_sizes
from reactorwatch.spc.prewhitening import Prewhitening

HORIZONS_MIN = (10.0, 60.0, 1440.0)
FIELDS = ("within_10_min", "within_1_h", "within_1_day")
RAMP = "ramp"

MOST_ROWS = 600
"""Rows after an onset that are computed; later ones are like their later half."""

FEWEST_ROWS = 20  # a training of fewer than two such halves states no power


class Deviation(NamedTuple):
    """A deviation, and what it does.

    Attributes:
        name: cause, or `{signal}.bias`.
        unit: unit of its size.
        largest: largest size within its bounds.
        path: mean of each output's prewhitened residual after a unit step, shape (onsets, rows, outputs).
    """

    name: str
    unit: str
    largest: float
    path: Array


class Watch(NamedTuple):
    """A plant as it is watched after its training.

    Attributes:
        config: settings of the monitor.
        reference: the reference.
        learned: prewhitening of each output.
        detectors: the charts of residuals.
        level_reaches: by output, the bias that the chart of levels sees in the long run, in its unit.
        steps: statistic of each output's test of lasting steps after a step of one unit, and its limit; empty without
            tests.
        residual_sds: standard deviations of residuals at equally likely distances of the inputs from the training.
        evaluated: for each output, True if it is evaluated.
        units: units by output.
        period_min: sampling period.
    """

    config: MonitorConfig
    reference: Reference
    learned: Sequence[Prewhitening]
    detectors: Sequence[Detector]
    level_reaches: dict[str, float]
    steps: Sequence[tuple[float, float]]
    residual_sds: Sequence[float]
    evaluated: Sequence[bool]
    units: dict[str, str]
    period_min: float


def state_power(watch: Watch, rows: TrainingRows) -> list[Power]:
    """Sizes of steps, then of ramps, that are seen; empty for a training that is too short."""
    deviations = _deviations(watch, rows)
    if not deviations:
        return []
    paths = np.stack([item.path for item in deviations])
    horizons = [minutes / watch.period_min for minutes in HORIZONS_MIN]
    stepped, tests = _add_step_tests(watch, [item.name for item in deviations], paths)
    steps = smallest_sizes(stepped, [*watch.detectors, *tests], horizons, 0.0)
    ramps = smallest_sizes(paths, watch.detectors, horizons, horizons[-1])
    return [
        _message(item, profile, np.minimum(sizes, _level_sizes(watch, item, profile)).tolist(), watch.period_min)
        for profile, found in (("", steps), (RAMP, ramps))
        for item, sizes in zip(deviations, found, strict=True)
    ]


def _level_sizes(watch: Watch, deviation: Deviation, profile: str) -> Array:
    """Sizes of a bias that the chart of levels sees in the last row of each horizon; infinite for other deviations.

    It looks at a slow signal, of which rows before the last say little more.
    """
    output, _, kind = deviation.name.rpartition(".")
    rows = np.floor(np.array(HORIZONS_MIN) / watch.period_min)
    weight = watch.config.chart_settings["level_weight"]
    gains = 1.0 - (1.0 - weight) ** rows
    if profile:
        gains = (rows - gains * (1.0 - weight) / weight) / max(rows[-1], 1.0)
    reach = watch.level_reaches.get(output, np.inf) if kind == "bias" else np.inf
    return reach / np.maximum(gains, 1e-300)


def _add_step_tests(watch: Watch, names: Sequence[str], paths: Array) -> tuple[Array, list[Detector]]:
    """Paths with a signal more for each test of lasting steps, and the tests as charts of these signals.

    A test looks at many rows at once; here it looks once, at the first row.
    """
    outputs = watch.config.outputs
    statistics = np.zeros((*paths.shape[:3], len(watch.steps)))
    for index, (name, (statistic, _)) in enumerate(zip(outputs, watch.steps, strict=False)):
        if f"{name}.bias" in names:
            statistics[names.index(f"{name}.bias"), :, 0, index] = statistic / np.array(watch.residual_sds)
    tests = [
        Detector((len(outputs) + index,), np.eye(1), 1.0, limit)
        for index, (_, limit) in enumerate(watch.steps)
        if watch.evaluated[index]
    ]
    return np.concatenate([paths, statistics], axis=3), tests


def _message(deviation: Deviation, profile: str, sizes: Sequence[float], period_min: float) -> Power:
    power = Power(deviation=deviation.name, unit=deviation.unit, profile=profile)
    for name, minutes, size in zip(FIELDS, HORIZONS_MIN, sizes, strict=True):
        reached = size * minutes / HORIZONS_MIN[-1] if profile else size
        if isfinite(size) and reached <= deviation.largest and minutes >= period_min:  # a row has come by then
            setattr(power, name, size)
    return power


def _deviations(watch: Watch, rows: TrainingRows) -> list[Deviation]:
    arrays = rows.arrays
    if len(arrays.time_min) < 2 * FEWEST_ROWS:
        return []
    plant = watch.reference.plant
    if plant is not None and has_causes(watch.config, plant.equations):
        return _causes(watch, arrays)
    return _biases(watch, arrays)


def _causes(watch: Watch, arrays: RowArrays) -> list[Deviation]:
    """Causes that are traced, to first order about the filter's run over the training."""
    plant, known_plant = watch.reference.plant, watch.reference.known_plant
    assert plant is not None
    assert known_plant is not None
    (model, noise), effects = known_plant, causes_of(plant.equations)
    indices = output_indices(model, watch.config.outputs)
    outputs = model_outputs(model, watch.config.outputs, arrays.outputs)
    newest = list(zip(arrays.time_min.tolist(), arrays.inputs.tolist(), outputs.tolist(), strict=True))
    window = window_of(newest[-2 * MOST_ROWS :], Filter(model, noise))
    if window is None or window.time_min.size < 2 * FEWEST_ROWS:
        return []
    dynamics = GlrScan(model, noise, effects).dynamics(window)
    sds = np.ones(len(model.outputs))
    sds[indices] = watch.reference.typical_sd
    diagonal = np.ascontiguousarray(np.broadcast_to(np.diag(1.0 / sds), dynamics.whitening.shape))
    dynamics = replace(dynamics, whitening=diagonal)
    intervals = window.time_min.size - 1
    rows = min(MOST_ROWS, intervals // 2)
    onsets = np.linspace(1, intervals - rows, 6).astype(int)
    profile = (np.arange(intervals)[:, None] >= onsets).astype(np.float64)
    found = []
    for index, effect in enumerate(effects):
        g = forward_signatures(dynamics, index, profile, profile)
        z = np.stack([g[onset : onset + rows, indices, i] for i, onset in enumerate(onsets.tolist())])
        largest = max(abs(effect.lower), abs(effect.upper))
        found.append(Deviation(effect.name, effect.unit, largest, _prewhiten(watch, z)))
    return found


def _biases(watch: Watch, arrays: RowArrays) -> list[Deviation]:
    """Biases of the outputs, by the difference that they make to normalised residuals."""
    reference, measured = watch.reference, arrays.outputs
    rows = min(MOST_ROWS, len(measured) // 2)
    onsets = np.linspace(FEWEST_ROWS // 2, len(measured) - rows, 2).astype(int).tolist()
    usual, found = reference.normalised_residuals(arrays), []
    responses = reference.step_responses(rows) if usual is None else None
    for index, name in enumerate(watch.config.outputs):
        if not watch.evaluated[index]:
            continue
        paths = np.zeros((1, rows, len(watch.config.outputs)))
        if responses is not None:
            paths[0, :, index] = np.nan_to_num(responses[index])
            paths = np.concatenate([paths / sd for sd in watch.residual_sds])
        if usual is not None:
            size, runs = reference.typical_sd[index], []
            for onset in onsets:
                shifted = measured.copy()
                shifted[onset:, index] += size
                found_shifted = reference.normalised_residuals(arrays._replace(outputs=shifted))
                change = (np.asarray(found_shifted) - usual) / size
                runs.append(np.nan_to_num(change[onset : onset + rows]))
            paths = np.stack(runs)
        found.append(Deviation(f"{name}.bias", watch.units.get(name, ""), np.inf, _prewhiten(watch, paths)))
    return found


def _prewhiten(watch: Watch, z: Array) -> Array:
    """Mean of the prewhitened residuals from that of the residuals, shape (onsets, rows, outputs)."""
    e = np.zeros(z.shape)
    for index, (learned, evaluated) in enumerate(zip(watch.learned, watch.evaluated, strict=True)):
        if evaluated:
            e[:, :, index] = z[:, :, index]
            for lag, coefficient in enumerate(learned.coefficients, 1):
                e[:, lag:, index] -= coefficient * z[:, :-lag, index]
            e[:, :, index] /= learned.sd
    return e

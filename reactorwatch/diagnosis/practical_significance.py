"""Curves for the figures of a diagnosis, their differences, and whether these exceed tolerances that a user gives."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.difference import Difference, compute_difference
from reactorwatch.diagnosis.holdout import Errors, simulate_outputs
from reactorwatch.diagnosis.result import Curves
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel


def curves_of(
    whole: Run,
    run: Run,
    model: ProcessModel,
    nominal: FittedHypothesis,
    best: FittedHypothesis,
    covariances: Sequence[Array],
) -> Curves:
    """Simulations of both models over the record, and the deviations of the causes.

    Args:
        whole: the record.
        run: the record without outliers.
        model: process model of the plant.
        nominal: hypothesis without any cause.
        best: best hypothesis.
        covariances: covariance of each effect's parameters.
    """
    outputs = model.output_names
    hypothesis, signals = best.hypothesis, best.hypothesis.signals(best.fit)
    offsets = hypothesis.offsets(best.fit)
    deviation, deviation_sd = {}, {}
    for part, signal, covariance in zip(best.parts, signals, covariances, strict=True):
        slope = part.profile.derivatives(part.parameters, part.profile.difference_steps).sample_value
        deviation[part.effect.name], n = signal.sample_value, part.profile.n_shape
        variance = np.einsum("ki,ij,kj->k", slope, covariance[:n, :n], slope)
        deviation_sd[part.effect.name] = np.sqrt(np.maximum(variance, 0.0))
    before = simulate_outputs(run, nominal.hypothesis.filter, (), offsets)
    after = before if best is nominal else simulate_outputs(run, hypothesis.filter, signals, offsets)

    def by_output(values: Array) -> dict[str, Array]:
        return dict(zip(outputs, values.T, strict=True))

    return Curves(
        run.time_min,
        dict(zip(model.input_names, run.inputs.T, strict=True)),
        by_output(whole.measured),
        by_output(before),
        by_output(after),
        by_output(_standardise(nominal)),
        by_output(_standardise(best)),
        deviation,
        deviation_sd,
    )


def differences_of(
    model: ProcessModel, noise_sd: Array, curves: Curves, bands: Mapping[str, float]
) -> dict[str, Difference]:
    """Differences of the simulation by output, over time and operating point, with the sensors' noise."""
    columns = curves.inputs | curves.simulated_before
    units = {item.name: item.unit for item in model.inputs} | {item.name: item.unit for item in model.outputs}
    signals = {name: (columns[name], unit) for name, unit in units.items()}
    return {
        output.name: compute_difference(
            curves.measured[output.name] - curves.simulated_before[output.name],
            curves.residual_before[output.name],
            float(noise_sd[index]),
            output.unit,
            curves.time_min,
            signals,
            bands[output.name],
        )
        for index, output in enumerate(model.outputs)
    }


def _standardise(item: FittedHypothesis) -> Array:
    return np.asarray(item.fit.innovations.residual / item.fit.innovations.sd)


PRACTICAL_SHARE = 0.02
"""Default tolerance as a fraction of the output's range in the record."""


def check_tolerance(model: ProcessModel, tolerance: Mapping[str, float]) -> None:
    """Check that tolerances are valid.

    Raises:
        InputError: a tolerance is of no output, or not positive.
    """
    for name, value in tolerance.items():
        if name not in model.output_names:
            raise InputError(f"tolerance must be of {', '.join(model.output_names)}, got {name}")
        if not 0.0 < value < np.inf:
            raise InputError(f"tolerance of {name} must be a positive number, got {value:g}")


def tolerances_of(run: Run, model: ProcessModel, tolerance: Mapping[str, float]) -> dict[str, float]:
    """Tolerated root mean square difference of each output, in its unit.

    Args:
        run: the record.
        model: process model of the plant.
        tolerance: tolerances given by the user, by output.

    Raises:
        InputError: a tolerance is of no output, or not positive.
    """
    check_tolerance(model, tolerance)
    ranges = np.nanquantile(run.measured, 0.99, axis=0) - np.nanquantile(run.measured, 0.01, axis=0)
    return {
        name: tolerance.get(name, PRACTICAL_SHARE * float(size))
        for name, size in zip(model.output_names, ranges, strict=True)
    }


def exceeds_tolerance(curves: Curves, bands: Mapping[str, float], blind: NDArray[np.bool_]) -> bool:
    """Return true if the simulations of the two models differ by more than the tolerance in an output.

    Args:
        curves: simulations of both models.
        bands: the tolerances, by output.
        blind: rows without a prediction of the filter, such as the first row of a run, shape (rows,).
    """
    for output, band in bands.items():
        difference = (curves.simulated_after[output] - curves.simulated_before[output])[~blind]
        finite = difference[np.isfinite(difference)]
        if finite.size < difference.size or float(np.sqrt(np.mean(finite**2))) > band:
            return True
    return False


def residual_exceeds_tolerance(
    before: Errors, noise_sd: Array, model: ProcessModel, bands: Mapping[str, float]
) -> bool:
    """Return true if the nominal simulation's error exceeds noise and tolerance in an output.

    Args:
        before: errors of the nominal model.
        noise_sd: standard deviation of the sensors' noise, shape (n_y,), see `colored_noise`.
        model: process model of the plant.
        bands: tolerances, by output.
    """
    residual = np.sqrt(np.maximum(before.simulation**2 - noise_sd**2, 0.0))
    return any(not value <= bands[name] for name, value in zip(model.output_names, residual.tolist(), strict=True))

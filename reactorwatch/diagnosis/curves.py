"""Curves for the figures of a diagnosis, and the differences between a simulation and its record."""

from collections.abc import Sequence

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.difference import Difference, compute_difference
from reactorwatch.diagnosis.holdout import simulate_outputs
from reactorwatch.diagnosis.result import Curves
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis
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


def differences_of(model: ProcessModel, noise_sd: Array, curves: Curves) -> dict[str, Difference]:
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
        )
        for index, output in enumerate(model.outputs)
    }


def _standardise(item: FittedHypothesis) -> Array:
    return np.asarray(item.fit.innovations.residual / item.fit.innovations.sd)

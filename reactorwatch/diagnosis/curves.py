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
    for effect, profile, parameters, signal, part in zip(
        hypothesis.filter.effects, hypothesis.profiles, best.fit.parameters, signals, covariances, strict=True
    ):
        slope = profile.derivatives(parameters, profile.difference_steps).sample_value
        deviation[effect.name], n = signal.sample_value, profile.n_shape
        deviation_sd[effect.name] = np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", slope, part[:n, :n], slope), 0.0))
    before = simulate_outputs(run, nominal.hypothesis.filter, (), offsets)
    after = before if best is nominal else simulate_outputs(run, hypothesis.filter, signals, offsets)
    return Curves(
        run.time_min,
        dict(zip(model.input_names, run.inputs.T, strict=True)),
        dict(zip(outputs, whole.measured.T, strict=True)),
        dict(zip(outputs, before.T, strict=True)),
        dict(zip(outputs, after.T, strict=True)),
        dict(zip(outputs, _standardise(nominal).T, strict=True)),
        dict(zip(outputs, _standardise(best).T, strict=True)),
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

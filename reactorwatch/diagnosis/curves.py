"""What the pictures of a diagnosis are drawn from, and where a simulation differs from its record."""

from collections.abc import Sequence

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.difference import Difference, difference
from reactorwatch.diagnosis.holdout import free_run
from reactorwatch.diagnosis.result import Curves
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import Explained
from reactorwatch.process.model import ProcessModel


def curves_of(
    whole: Run, run: Run, model: ProcessModel, nominal: Explained, best: Explained, covariances: Sequence[Array]
) -> Curves:
    """Both simulations over the record, and the courses of the causes.

    Args:
        whole: the record.
        run: the same without outliers.
        model: of the plant.
        nominal: without any cause.
        best: explanation.
        covariances: of the numbers of each of its effects.
    """
    outputs = model.output_names
    hypothesis, signals = best.hypothesis, best.hypothesis.signals(best.fit)
    known = hypothesis.offsets(best.fit)
    deviation, deviation_sd = {}, {}
    for effect, course, theta, signal, part in zip(
        hypothesis.sized.effects, hypothesis.courses, best.fit.theta, signals, covariances, strict=True
    ):
        slope = course.derivatives(theta, course.least_differences).at_row
        deviation[effect.name] = signal.at_row
        deviation_sd[effect.name] = np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", slope, part, slope), 0.0))
    before = free_run(run, nominal.hypothesis.sized, (), known)
    after = before if best is nominal else free_run(run, hypothesis.sized, signals, known)
    return Curves(
        run.time_min,
        dict(zip(model.input_names, run.inputs.T, strict=True)),
        dict(zip(outputs, whole.measured.T, strict=True)),
        dict(zip(outputs, before.T, strict=True)),
        dict(zip(outputs, after.T, strict=True)),
        dict(zip(outputs, _standardised(nominal).T, strict=True)),
        dict(zip(outputs, _standardised(best).T, strict=True)),
        deviation,
        deviation_sd,
    )


def differences_of(model: ProcessModel, noise_sd: Array, curves: Curves) -> dict[str, Difference]:
    """Differences of the simulation by output, time and operating point, beside the noise of the sensors."""
    columns = curves.inputs | curves.free_before
    units = {item.name: item.unit for item in model.inputs} | {item.name: item.unit for item in model.outputs}
    signals = {name: (columns[name], unit) for name, unit in units.items()}
    return {
        output.name: difference(
            curves.measured[output.name] - curves.free_before[output.name],
            curves.residual_before[output.name],
            float(noise_sd[place]),
            output.unit,
            curves.time_min,
            signals,
        )
        for place, output in enumerate(model.outputs)
    }


def _standardised(item: Explained) -> Array:
    return np.asarray(item.fit.found.residual / item.fit.found.sd)

"""A sensor with steps of q has noise of at least q / sqrt(12), in every result that states its noise."""

from math import hypot, sqrt

import numpy as np
import pytest

from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.identifiability import identifiability
from reactorwatch.diagnosis.record_checks import excite, make_run
from reactorwatch.diagnosis.search.search import Search, smallest_noise
from reactorwatch.process.generic import generic_effects
from reactorwatch.process.library.cascaded_tanks import tanks
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record

PLANTS = {"tanks": (tanks, (1.0, 4.0), [3.0, 3.0]), "three_tanks": (three_tanks, (15.0, 45.0), [40.0, 20.0, 30.0])}


def quantised(name: str, noise_sd: float, step: float) -> tuple[ProcessModel, Record]:
    """Record of a sound plant whose sensors have noise and steps."""
    make, (low, high), start = PLANTS[name]
    model, random, rows = make(), np.random.default_rng(1), 600
    inputs = np.repeat(random.uniform(low, high, (rows // 20, len(model.inputs))), 20, axis=0)
    time_min = 0.1 * np.arange(rows, dtype=np.float64)
    outputs = Simulator(model).run(time_min, inputs, np.array(start)).outputs
    outputs = step * np.round((outputs + noise_sd * random.standard_normal(outputs.shape)) / step)
    columns = dict(zip((*model.input_names, *model.output_names), np.hstack([inputs, outputs]).T, strict=True))
    return model, Record(time_min, columns, name)


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize(("noise_sd", "step"), [(0.001, 0.1), (0.001, 0.7), (0.05, 0.02), (0.05, 0.1), (0.05, 0.5)])
def test_the_noise_of_a_sensor_in_steps_is_that_of_its_steps_at_least(name: str, noise_sd: float, step: float) -> None:
    model, record = quantised(name, noise_sd, step)
    run = make_run(record, model)
    search = Search(model, (), run, smallest_noise(model, run.measured))
    for sd in search.noise.measurement_sd:
        assert step / sqrt(12.0) * (1.0 - 1e-9) <= sd < 1.35 * hypot(noise_sd, step / sqrt(12.0))


@pytest.mark.slow
def test_a_diagnosis_states_the_noise_of_the_steps() -> None:
    step = 1.0
    model, record = quantised("three_tanks", 0.001, step)
    result = diagnose(record, model)
    for item in result.differences.values():
        assert step / sqrt(12.0) * (1.0 - 1e-9) <= item.noise_sd < 1.35 * step / sqrt(12.0)
    for held_out in result.gain.held_out.values():
        assert held_out.noise_sd >= step / sqrt(12.0) * (1.0 - 1e-9)


def test_a_coarse_sensor_shows_only_larger_causes() -> None:
    model = tanks()
    effects = tuple(item for item in generic_effects(model) if item.name in ("x2.bias", "x2.noise", "u.gain"))
    smallest = []
    for resolution in ({}, {"x2": 1.0}, {"x2": 2.0}):
        record = excite(model, resolution)
        for name, step in resolution.items():
            np.testing.assert_allclose(record.columns[name] / step, np.round(record.columns[name] / step), atol=1e-9)
        found = identifiability(model, effects, make_run(record, model))
        smallest.append({item.effect.name: item.smallest for item in found.causes if item.is_visible})
    for fine, coarse in ((smallest[0], smallest[1]), (smallest[1], smallest[2])):
        assert set(coarse) <= set(fine)
        assert all(coarse[name] > fine[name] for name in coarse)

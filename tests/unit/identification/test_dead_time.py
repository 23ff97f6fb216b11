"""Dead times of random plants, found from their records."""

import re

import numpy as np
import pytest
from scipy.signal import lfilter

from reactorwatch.identification.data import Dataset
from reactorwatch.identification.dead_time import find_dead_times
from reactorwatch.identification.identify import ModelForm, identify
from reactorwatch.sentences.models import identification_headline
from tests.unit.identification.test_selection import closed_loop


def random_plant(seed: int, inputs: int) -> tuple[Dataset, np.ndarray]:
    """Record of a sum of second-order responses to random steps, with 5 % noise, and its dead times."""
    rng, rows = np.random.default_rng(seed), 1500
    u, y, delays = np.zeros((rows, inputs)), np.zeros(rows), rng.integers(2, 21, inputs)
    for i, delay in enumerate(delays):
        u[:, i] = np.repeat(rng.standard_normal(rows), rng.geometric(1.0 / rng.integers(10, 60), rows))[:rows]
        denominator = np.poly(rng.uniform(0.5, 0.95, 2))
        response = lfilter([1.0, rng.uniform(0.0, 1.0)], denominator, u[:, i]) * np.sum(denominator)
        y[delay:] += response[:-delay]
    y += 0.05 * np.std(y) * rng.standard_normal(rows)
    return Dataset.of(np.arange(rows), u, y), delays


@pytest.mark.parametrize("inputs", [1, 2, 3])
def test_dead_times_of_random_plants_are_found_within_one_row_in_95_of_100(inputs: int) -> None:
    records = [random_plant(1_540_000 + 1000 * inputs + seed, inputs) for seed in range(40)]
    errors = np.concatenate([find_dead_times(data) - delays for data, delays in records])
    assert np.mean(np.abs(errors) <= 1) >= 0.95


def test_slow_responses_and_feedback_do_not_pretend_a_dead_time() -> None:
    """Cascaded tanks respond in hundreds of rows; the input of a loop follows the output of the row before."""
    u, rng = np.repeat(np.random.default_rng(5).uniform(1.0, 4.0, 60), 20), np.random.default_rng(6)
    slow = lfilter([0.0, 4e-4], np.poly([0.98, 0.98]), u) + 0.01 * rng.standard_normal(u.size)
    assert find_dead_times(Dataset.of(np.arange(u.size), u, slow))[0] <= 2
    assert find_dead_times(Dataset.of(np.arange(2000), *closed_loop(1.1))) == (1,)


@pytest.mark.parametrize(("centre", "noise"), [(0.0, 0.0), (1e6, 1e-6), (0.0, 0.1)])
def test_a_pure_delay_is_found_at_any_offset_and_without_noise(centre: float, noise: float) -> None:
    rng = np.random.default_rng(9)
    u = np.repeat(rng.standard_normal(90), 10)
    y = np.roll(u, 7) + noise * rng.standard_normal(900)
    assert find_dead_times(Dataset.of(np.arange(900), u + centre, y + centre)) == (7,)


def test_an_input_without_effect_keeps_all_its_lags() -> None:
    data, delays = random_plant(1_541_007, 1)
    both = np.column_stack([data.inputs, np.random.default_rng(8).permutation(data.inputs)])
    found = find_dead_times(Dataset.of(data.time, both, data.output))
    assert abs(found[0] - delays[0]) <= 1
    assert found[1] == 1


def test_residuals_that_are_correlated_with_past_inputs_name_the_dead_time() -> None:
    data, delays = random_plant(9, 1)
    wrong, right = (identify(data, ModelForm("oe", 2, delay)).checks["independence"] for delay in (1, int(delays[0])))
    assert re.search(rf"dead time {delays[0]} rows, where the model has 1 \(--delay {delays[0]}\)", wrong)
    assert right == "ok"


def test_an_unstable_plant_is_named_by_any_model_and_its_free_run_diverges() -> None:
    data = Dataset.of(np.arange(2000), *closed_loop(1.1))
    arx, oe = (identify(data, ModelForm(model, 1)) for model in ("arx", "oe"))
    assert arx.fit.free_run == -np.inf
    assert "free run diverges" in identification_headline(arx)
    for found in (arx, oe):
        assert "the plant is unstable: its ARX model has a pole at 1.1" in found.checks["stability"]


def test_identify_with_delay_auto_names_the_dead_time_of_each_input() -> None:
    data, delays = random_plant(7, 2)
    named = dict(zip(data.input_names, delays.tolist(), strict=True))
    found, true = (identify(data, ModelForm("oe", 2, delay)) for delay in ("auto", named))
    assert isinstance(found.delay, dict)
    assert all(abs(found.delay[name] - delay) <= 1 for name, delay in named.items())
    assert found.fit.free_run >= true.fit.free_run - 2.0

"""Dead times of random plants, found from their records."""

import numpy as np
from scipy.signal import lfilter

from reactorwatch.identification.data import Dataset
from reactorwatch.identification.dead_time import find_dead_times
from reactorwatch.identification.identify import ModelForm, identify


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


def test_dead_times_of_one_to_three_inputs_of_random_plants_are_found_within_one_row_in_95_of_100() -> None:
    records = [random_plant(1_520_000 + 100 * inputs + seed, inputs) for inputs in (1, 2, 3) for seed in range(40)]
    errors = np.concatenate([find_dead_times(data) - delays for data, delays in records])
    assert np.mean(np.abs(errors) <= 1) >= 0.95


def test_identify_with_delay_auto_names_the_dead_time_of_each_input() -> None:
    data, delays = random_plant(7, 2)
    named = dict(zip(data.input_names, delays.tolist(), strict=True))
    found, true = (identify(data, ModelForm("oe", 2, delay)) for delay in ("auto", named))
    assert isinstance(found.delay, dict)
    assert all(abs(found.delay[name] - delay) <= 1 for name, delay in named.items())
    assert found.fit.free_run >= true.fit.free_run - 2.0

"""A sensor that is late: its values are moved to when they were true, and the filter loses nothing by it."""

import numpy as np
import pytest

from reactorwatch.diagnosis.fitting.augmented_model import shift_measurements
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.profiles import Constant
from reactorwatch.diagnosis.run import Run
from reactorwatch.process.library.cstr import EFFECTS, cstr
from tests.unit.diagnosis.runs import make_run

SENSORS = Noise((0.002, 0.3), (0.0, 0.0))
DELAY = next(effect for effect in EFFECTS if effect.name == "concentration_delay")


def test_each_value_is_where_it_was_true_and_inputs_are_held() -> None:
    run = Run(np.arange(4.0), np.array([[1.0], [2.0], [3.0], [4.0]]), np.arange(8.0).reshape(4, 2))
    by = shift_measurements(run, run.inputs, np.array([True]), 0, np.full(4, 0.25))
    assert by.run.time_min.tolist() == [0.0, 0.75, 1.0, 1.75, 2.0, 2.75, 3.0]
    np.testing.assert_array_equal(by.run.measured[:, 0], [0.0, 2.0, np.nan, 4.0, np.nan, 6.0, np.nan])
    np.testing.assert_array_equal(by.run.measured[:, 1], [1.0, np.nan, 3.0, np.nan, 5.0, np.nan, 7.0])
    assert by.run.inputs[:, 0].tolist() == [1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 4.0]


@pytest.mark.parametrize("delay_min", [0.1, 0.27])
def test_with_the_right_delay_the_innovations_are_those_of_a_prompt_sensor(delay_min: float) -> None:
    run = make_run(f"concentration_delay:constant:{delay_min}", rows=1500)
    profile = Constant(run.time_min)
    late = FaultFilter(cstr(), (DELAY,), SENSORS)
    losses = [late.evaluate(run, [profile.signal(np.array([delay]))])[0] for delay in (0.0, delay_min)]
    _, w, _ = late.evaluate(run, [profile.signal(np.array([delay_min]))])
    assert losses[1] < losses[0] - 1000.0
    assert np.nanmean(w[100:] ** 2) == pytest.approx(1.0, abs=0.08)  # 2800 values: 0.027 by chance


def test_after_a_break_it_begins_with_all_that_is_measured() -> None:
    run = make_run("concentration_delay:constant:0.3", rows=600)
    broken = Run(run.time_min, run.inputs, run.measured, breaks=(300,))
    profile = Constant(run.time_min)
    _, w, found = FaultFilter(cstr(), (DELAY,), SENSORS).evaluate(broken, [profile.signal(np.array([0.3]))])
    assert np.all(np.isnan(found.prediction[300]))
    assert np.all(np.isfinite(w[305:]))
    assert np.max(np.abs(w[305:])) < 6.0


def test_what_was_true_before_a_break_is_held_against_no_delay() -> None:
    """In three rows in twenty the analyser shows what nobody can know; the right delay is likeliest nevertheless."""
    run = make_run("concentration_delay:constant:0.3", rows=1200)
    broken = Run(run.time_min, run.inputs, run.measured, breaks=tuple(range(20, 1200, 20)))
    profile = Constant(run.time_min)
    late = FaultFilter(cstr(), (DELAY,), SENSORS)
    losses = {
        delay: late.evaluate(broken, [profile.signal(np.array([delay]))])[0] for delay in (0.1, 0.2, 0.3, 0.4, 0.5)
    }
    assert min(losses, key=lambda delay: losses[delay]) == 0.3

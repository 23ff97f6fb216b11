"""Held-out rows exclude those after intervals with unknown inputs."""

import numpy as np
import pytest

from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Step
from reactorwatch.diagnosis.holdout import evaluate_holdout, holdout_rows
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis
from reactorwatch.process.library.cstr import EFFECTS, cstr
from tests.unit.diagnosis.runs import make_run

SENSORS = Noise((0.002, 0.3), (0.0, 0.0))
COOLANT = next(effect for effect in EFFECTS if effect.name == "coolant_flow")


def without_changes(run: Run) -> Run:
    """The run with the rows missing in which its input changed, every tenth time."""
    changed = np.flatnonzero(np.diff(run.inputs[:, 0])) + 1
    there = np.ones(run.time_min.size, dtype=bool)
    there[changed[::10]] = False
    breaks = np.flatnonzero(np.diff(run.time_min[there]) > 0.15) + 1
    return Run(run.time_min[there], run.inputs[there], run.measured[there], tuple(breaks.tolist()))


def test_where_the_time_of_an_input_change_is_unknown_no_model_is_blamed_for_it() -> None:
    run = without_changes(make_run("coolant_flow:step:-0.03@100.37min", rows=6000))
    profile, truth = Step(run.time_min), np.array([-0.03, 100.37])
    nominal = Hypothesis(FaultFilter(cstr(), (), SENSORS), ())
    leaking = Hypothesis(FaultFilter(cstr(), (COOLANT,), SENSORS), (profile,))
    before, after = evaluate_holdout(
        run,
        FittedHypothesis(nominal, nominal.evaluate(run, ()), 0.0),
        FittedHypothesis(leaking, leaking.evaluate(run, (truth,)), 0.0),
    )
    assert np.count_nonzero(holdout_rows(run)) > 500
    assert after.simulation / SENSORS.measurement_sd == pytest.approx(1.0, abs=0.09)  # of 500 values, 3 % by chance
    assert before.simulation[1] > 4.0 * after.simulation[1]


def test_where_hardly_a_row_is_free_of_doubt_all_are_judged() -> None:
    time_min = np.linspace(0.0, 99.9, 1000)
    run = Run(time_min, np.zeros((1000, 1)), np.zeros((1000, 2)), tuple(range(20, 1000, 20)))
    assert np.count_nonzero(holdout_rows(run)) == 200

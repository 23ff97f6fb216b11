"""The bank holds every cause that the monitor compares, in sizes that can be; its records follow the equations."""

from collections import Counter

import numpy as np
import pytest

from benchmarks.faults.bank import AFTER_MIN, BANK, GRADES, ONSET_MIN, TWINS, Case, Fault, cases
from benchmarks.faults.runs import NOISE_SD, fault_free, record_of, truth_of
from monitor_node.causes.isolation import causes_of
from reactorwatch.arrays import Array
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.profiles import STEP
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import start_state
from reactorwatch.records.record import Record

CAUSES = causes_of(cstr())

RAMP = Fault("temperature_bias", "ramp", (0.2, 1.0, 8.0))


def test_every_cause_of_the_monitor_is_in_the_bank_as_a_step() -> None:
    assert {fault.cause for fault in BANK if fault.profile == "step"} == {effect.name for effect in CAUSES}


def test_every_case_is_one_that_the_plant_takes() -> None:
    assert all(parse_fault(case.specification).values["size"] == case.size for case in cases(2))


def test_each_fault_comes_in_three_rising_sizes_and_as_many_runs_as_asked_for() -> None:
    assert all(0 < small < medium < large for small, medium, large in (fault.sizes for fault in BANK))
    counts = Counter((case.fault.name, case.grade) for case in cases(4))
    assert counts == {(fault.name, grade): 4 for fault in BANK for grade in GRADES}


def test_no_two_cases_share_a_seed() -> None:
    found = cases(20)
    assert len({case.seed for case in found}) == len(found)


def test_signs_alternate_where_both_make_sense() -> None:
    signs = {fault.name: {np.sign(case.size) for case in cases(4) if case.fault == fault} for fault in BANK}
    assert all(signs[fault.name] == set(fault.signs) for fault in BANK)


@pytest.fixture(scope="module")
def ramp() -> tuple[Case, Record]:
    case = Case(RAMP, "large", -8.0, 302.34, 7)
    return case, record_of(case)


def test_a_record_differs_from_its_truth_by_the_noise_of_the_sensors_alone(ramp: tuple[Case, Record]) -> None:
    case, record = ramp
    noise = np.stack([record.columns["C"], record.columns["T"]], axis=1) - truth_of(case, record).faulty
    # The standard error of a standard deviation from 4,500 values is 1 %, that of their autocorrelation 1.5 %.
    assert np.std(noise, axis=0) == pytest.approx(NOISE_SD, rel=0.05)
    assert [abs(np.corrcoef(column[1:], column[:-1])[0, 1]) for column in noise.T] < [0.06, 0.06]


def test_until_the_onset_the_fault_changes_nothing_and_a_ramp_then_reaches_its_size(ramp: tuple[Case, Record]) -> None:
    case, record = ramp
    truth = truth_of(case, record)
    before = record.time_min < case.onset_min
    assert np.array_equal(truth.nominal[before], truth.faulty[before])
    assert truth.faulty[-1] - truth.nominal[-1] == pytest.approx([0.0, -8.0], abs=1e-9)


def test_a_run_lasts_for_the_time_in_which_faults_are_to_be_found(ramp: tuple[Case, Record]) -> None:
    case, record = ramp
    assert case.onset_min >= ONSET_MIN
    assert 0 <= case.onset_min + AFTER_MIN - record.time_min[-1] < 0.1


def test_a_gross_loss_of_heat_is_noted_to_put_the_reactor_out() -> None:
    case = Case(Fault("heat_loss", "step", (0.01, 0.02, 0.1)), "large", 0.1, 300.0, 3)
    assert truth_of(case, record_of(case)).left_branch


@pytest.mark.parametrize("phi", [0.0, 0.5])
def test_noise_is_as_autocorrelated_as_asked_for_and_always_of_the_same_spread(phi: float) -> None:
    columns = [fault_free(seed=5, rows=4000, phi=value).columns for value in (phi, 0.999999)]
    # At phi = 1 the noise never changes: that run is the noise-free one, shifted.
    noise = np.stack([columns[0][signal] - columns[1][signal] for signal in ("C", "T")], axis=1)
    assert np.std(noise, axis=0) == pytest.approx(NOISE_SD, rel=0.1)
    assert [np.corrcoef(column[1:], column[:-1])[0, 1] for column in noise.T] == pytest.approx([phi, phi], abs=0.06)


def test_twins_are_the_causes_that_imitate_each_other_but_for_a_hundredth() -> None:
    signatures = {effect.name: _signature(effect.name) for effect in CAUSES}
    found = {
        cause: {
            other
            for other, rival in signatures.items()
            if other != cause and 1 - (own @ rival) ** 2 / ((own @ own) * (rival @ rival)) < 0.01
        }
        for cause, own in signatures.items()
    }
    assert {cause: set(twins) for cause, twins in TWINS.items()} == {c: twins for c, twins in found.items() if twins}


def _signature(cause: str) -> Array:
    """What a tenth of the small step does to both measurements, over their noise, in two runs."""
    fault = next(item for item in BANK if item.cause == cause and item.profile == "step")
    effect = next(item for item in CAUSES if item.name == cause)
    simulator = Simulator(effect.extend(cstr(), STEP))
    changes = {f"{cause}.size": fault.signs[0] * fault.sizes[0] / 10, f"{cause}.onset": 20.0}
    time_min = np.arange(round((20 + AFTER_MIN) * 10)) / 10
    parts = []
    for seed in (1, 2):
        flows = np.repeat(np.random.default_rng(seed).uniform(90, 111, time_min.size // 10), 10)
        start = start_state(cstr(), flows[:1], "operating")
        runs = [simulator.run(time_min, flows, start, item).outputs for item in (changes, {})]
        parts.append((runs[0] - runs[1]) / NOISE_SD)
    return np.concatenate(parts).ravel()

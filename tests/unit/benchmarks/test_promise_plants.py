"""The plants of `make promise` are the reactor by an independent integration, each with its difference."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.harness import plants
from benchmarks.harness.plants import FLOWS, INPUTS, KINDS, Kind, simulate
from benchmarks.harness.study import Pool, median_interval, poisson_interval, share_interval
from benchmarks.promise import black_box
from benchmarks.promise.not_quite import Outcome, Plant, print_counts, print_delays
from plant_node.record import simulate_record
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.simulate import Simulator

ROOT = Path(__file__).parents[3]
RANDOM_STEPS = INPUTS["a new flow in 90 to 111 each minute"]
EFFECT_OF = {
    "reaction 3 % slower": "reaction_rate:constant:-0.03",
    "valve lag of 0.12 min": "valve_lag:constant:0.12",
    "feed 1 K warmer": "feed_temperature:constant:1",
    "3 % more volume": "volume:constant:0.03",
    "heat loss of 0.003 1/min": "heat_loss:constant:0.003",
}


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plants, "SPAN_MIN", 30.0)
    monkeypatch.setattr(plants, "NOISE", {"C": 0.0, "T": 0.0})


def test_the_nominal_plant_is_that_of_the_simulator() -> None:
    record = simulate(Kind("nominal"), RANDOM_STEPS, 3)
    run = Simulator(cstr()).run(record.time_min, record.columns["qc"], np.array([0.1, 438.54]))
    np.testing.assert_allclose(record.columns["C"], run.outputs[:, 0], atol=1e-6)
    np.testing.assert_allclose(record.columns["T"], run.outputs[:, 1], atol=1e-3)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind.name in EFFECT_OF], ids=lambda kind: kind.name)
def test_a_difference_since_ever_is_that_of_the_catalogue_s_effect(kind: Kind) -> None:
    from plant_node.config import PlantConfig

    record = simulate(kind, RANDOM_STEPS, 3)
    config = PlantConfig(faults=(EFFECT_OF[kind.name],), noise_sd={"C": 0.0, "T": 0.0})
    other = simulate_record(config, record.rows, driver=record)
    settled = record.time_min > 10.0  # both begin at the same state, the effect's own states elsewhere
    np.testing.assert_allclose(record.columns["C"][settled], other.columns["C"][settled], atol=2e-5)
    np.testing.assert_allclose(record.columns["T"][settled], other.columns["T"][settled], atol=1e-2)


def test_each_kind_of_noise_loss_and_step_is_in_the_record() -> None:
    by_name = {kind.name: kind for kind in KINDS}
    nominal = simulate(Kind("nominal"), RANDOM_STEPS, 3)
    assert simulate(replace(by_name["2 % of the rows lost"], lost=0.5), RANDOM_STEPS, 3).rows < 0.7 * nominal.rows
    assert np.isfinite(simulate(by_name["C every tenth row"], RANDOM_STEPS, 3).columns["C"]).mean() == pytest.approx(
        0.1
    )
    stepped = simulate(by_name["sensors in steps"], RANDOM_STEPS, 3).columns["T"]
    np.testing.assert_allclose(stepped / 0.5, np.round(stepped / 0.5))
    memory = simulate(by_name["noise with memory"], RANDOM_STEPS, 3).columns["T"] - nominal.columns["T"]
    assert np.corrcoef(memory[1:], memory[:-1])[0, 1] > 0.7
    warm = simulate(Kind("nominal"), RANDOM_STEPS, 3, warmer_from_min=20.0).columns["T"] - nominal.columns["T"]
    assert np.abs(warm[nominal.time_min < 20.0]).max() == 0.0
    assert warm[nominal.time_min > 25.0].mean() > 0.3


def test_the_interval_of_a_count_is_that_of_garwood() -> None:
    """Table of Garwood (1936), Fiducial limits for the Poisson distribution, Biometrika 28: 3 and 0 events."""
    assert poisson_interval(3) == pytest.approx((0.619, 8.767), abs=1e-3)
    assert poisson_interval(0) == pytest.approx((0.0, 3.689), abs=1e-3)


def test_the_interval_of_a_share_is_that_of_clopper_and_pearson() -> None:
    assert share_interval(8, 10) == pytest.approx((0.4439, 0.9748), abs=1e-4)
    assert share_interval(10, 10) == pytest.approx((0.6915, 1.0), abs=1e-4)
    assert share_interval(0, 10)[0] == 0.0


def test_the_interval_of_a_median_is_between_the_values_of_the_sign_test() -> None:
    """Conover (1999), Practical nonparametric statistics, section 3.2: the 2nd and the 9th of ten, the 6th and 15th."""
    assert median_interval([float(value) for value in range(10, 0, -1)]) == (2.0, 9.0)
    assert median_interval([float(value) for value in range(1, 21)]) == (6.0, 15.0)


def test_the_tables_count_alarms_by_input_and_plants_whose_promise_is_not_kept(
    capsys: pytest.CaptureFixture[str],
) -> None:
    watched = [Plant(0, 0), Plant(0, 1), Plant(1, 2)]
    outcomes = iter([Outcome([1.0, 2.0], 0.25, True), Outcome([], 0.25, False), Outcome([3.0], 0.5, True)])
    print_counts("a rate", watched, outcomes)
    lines = capsys.readouterr().out.splitlines()
    assert lines[2] == "| reaction 3 % slower | 2 + 0 + 0 | 0.5 | 1 |"
    assert lines[4].startswith("| all | 3 (95 %: 0.6 to 8.8) | 1 | 1 of 3 |")
    print_delays([Plant(5, 0, is_faulty=True)] * 2, iter([Outcome([401.0], 0.0, True), Outcome([], 0.0, True)]))
    assert capsys.readouterr().out.endswith(
        "1 of 2 seen within 10 min (95 %: 1 to 99 %), median inf min (1.00 to inf); unseen: feed that wanders.\n"
    )


def test_the_tables_of_black_boxes_and_of_faults_have_a_line_for_each_kind(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def result(job: black_box.Job) -> black_box.Result:
        is_kept = job.seed > black_box.SEED
        return black_box.Result(2 * (job.inputs == "wide"), 0.5, 100, 90, 0.5 if is_kept else 3.0, is_kept)

    monkeypatch.setattr(black_box, "watch", result)
    black_box.print_table(Pool(1), black_box.jobs_of(2, "auto", ["low"], list(FLOWS)))
    lines = capsys.readouterr().out.splitlines()
    assert lines[2] == "| low | wide | 4 | 1.00 | 4.00 (1.09 to 10.24) | 1 of 2 | 3.5 | 90.0 % |"
    groups = ["all", "all that are said to be kept", "all that are said not to be kept"]
    assert [line.split(" | ")[1] for line in lines[2:]] == [*FLOWS, *groups]
    monkeypatch.setattr(black_box, "find_delay", lambda job: 1.0 if job.has_equations else np.inf)
    black_box.print_faults(Pool(1), 1)
    lines = capsys.readouterr().out.splitlines()
    assert lines[2] == "| steps, with equations | 13 | 100 % (75 to 100) | 1.00 (1.00 to 1.00) |"
    assert lines[4].startswith("| steps, without equations | 13 | 0 % (0 to 25) | inf (inf to inf) |")
    assert lines[6].startswith("| all, with equations | 16 |")


@pytest.mark.slow
def test_the_command_prints_its_tables_from_worker_processes() -> None:
    command = [sys.executable, "-m", "benchmarks.promise", "--kinds", "1", "--only", "plants", "--jobs", "2"]
    found = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True)
    assert found.stdout.count("| all |") == 3
    assert "of 3 seen within 10 min" in found.stdout

"""A training shows what a filter has to estimate beside the states of the equations."""

from collections.abc import Callable
from dataclasses import replace as replace_model
from functools import cache

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from scipy.linalg import expm
from scipy.signal import lfilter

from benchmarks.harness.plants import INPUTS, KINDS, Kind, simulate
from benchmarks.inexact.foreign import FOLDER
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.learn.process_reference import ProcessMemory, ProcessReference
from monitor_node.learn.training_diagnosis import DiagnosisJob, Finding, Uncertain, describe_uncertain, find_uncertain
from monitor_node.learn.training_rows import RowArrays
from monitor_node.replay import backtest
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import Encoded
from reactorwatch.description.read import find_process
from reactorwatch.diagnosis.result import NOMINAL
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.kalman.filter_states import is_disturbance
from reactorwatch.process.extended_model import ExtendedModel
from reactorwatch.process.library.cstr import cstr
from tests.two_tanks import KEPT, PERIOD_MIN, record_of_two_tanks, two_tanks

from ..samples import samples
from ..warm_plant import changes, publish

WIDE, RARE, LITTLE = INPUTS.values()
KIND = {item.name: item for item in KINDS}
EXACT = Kind("as the model")
TRAINING_MIN = 60.0


@cache
def uncertain(kind: Kind, moves: int, seed: int = 11) -> tuple[str, ...]:
    record = simulate(kind, (WIDE, RARE, LITTLE)[moves], seed)
    rows = record.time_min < TRAINING_MIN
    measured = np.column_stack([record.columns[name][rows] for name in ("C", "T")])
    training = RowArrays(record.time_min[rows], record.columns["qc"][rows, None], measured)
    return find_uncertain(cstr(), ("C", "T"), training).names


def disturbances(kind: Kind, moves: int) -> set[str]:
    return {item for item in uncertain(kind, moves) if is_disturbance(item)}


def test_a_plant_as_the_model_whose_input_moved_over_its_range_needs_nothing() -> None:
    assert uncertain(EXACT, 0) == ()


@pytest.mark.parametrize("moves", [1, 2])
def test_a_training_with_few_or_small_moves_leaves_constants_open(moves: int) -> None:
    found = uncertain(EXACT, moves)
    assert "constant valve_lag" in found
    assert not any(map(is_disturbance, found))


def test_a_feed_that_wanders_is_a_disturbance_that_wanders() -> None:
    assert disturbances(KIND["feed that wanders"], 0) == {"wander T"}


@pytest.mark.parametrize("memory", [(0.9, 0.15), (0.7, 0.2)])
def test_noise_with_memory_is_coloured_noise(memory: tuple[float, float]) -> None:
    assert disturbances(Kind("noise with memory", noise_memory=memory), 0) == {"noise T"}


@cache
def fit_two_tanks(seed: int, wandering: tuple[bool, bool], resolution: float) -> tuple[Uncertain, Array]:
    """Additional states that the first 1,000 rows show, and the innovations of 9,000 later ones."""
    record, model = record_of_two_tanks(seed, 10_000, wander=(0.06 * wandering[0], 0.06 * wandering[1])), two_tanks()
    inputs, measured = (np.column_stack([record.columns[f"{name}{i}"] for i in (1, 2)]) for name in ("F", "h"))
    measured = np.round(measured / resolution) * resolution if resolution else measured
    training = RowArrays(record.time_min[:1000], inputs[:1000], measured[:1000])
    found = find_uncertain(model, model.output_names, training)
    widened = replace_model(model, uncertain=found.names)
    reference = ProcessReference.fit(widened, model.output_names, training, [resolution / 12.0**0.5] * 2)
    return found, reference.run(RowArrays(record.time_min, inputs, measured))[1000:]


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("wandering", [(False, False), (True, False), (False, True), (True, True)])
def test_inputs_that_wander_are_found_with_their_time_constant(wandering: tuple[bool, bool], seed: int) -> None:
    found, _ = fit_two_tanks(seed, wandering, 0.0)
    wander = {f"wander F{i}" for i, is_wandering in enumerate(wandering, start=1) if is_wandering}
    assert {*filter(is_disturbance, found.names)} == wander
    assert found.learned == pytest.approx([-PERIOD_MIN / np.log(KEPT)] * len(wander), rel=0.6)


@pytest.mark.parametrize("resolution", [0.0, 0.02, 0.05])
def test_innovations_are_white_together_where_inputs_wander(resolution: float) -> None:
    """An average of 50 rows of white vectors has the covariance of one row, less its 50th part."""
    assert largest_in_averages(fit_two_tanks(1, (True, True), resolution)[1]) < 1.5


def test_a_disturbance_is_not_understated() -> None:
    """From 1,000 rows its size is not known exactly; averages over many rows then vary more than predicted."""
    found = [largest_in_averages(fit_two_tanks(seed, (True, True), 0.05)[1]) for seed in (1, 2, 3, 4)]
    assert np.mean(found) < 1.1  # 1.24 with the likeliest size


def largest_in_averages(z: Array) -> float:
    """Variance of averages of 50 rows by that of white noise, in the direction in which it is largest."""
    averages = lfilter([0.02], [1.0, -0.98], z, axis=0)[500:]
    return float(np.max(np.linalg.eigvals(np.linalg.solve(np.cov(z.T), np.cov(averages.T) * 1.98 / 0.02)).real))


@pytest.mark.parametrize("step", [0.0, 0.3223])
def test_heaters_that_wander_are_found_behind_slow_sensors_with_coarse_steps(step: float) -> None:
    """TCLab by its exact solution, its sensors with noise of 0.13 steps, or that much without steps.

    White noise in the balances explains a training nearly as well, but with it averages vary 2.4 and 3.1 times as much
    as predicted.
    """
    plates, largest = find_process(str(FOLDER / "processes" / "tclab_simulator.py")).model, []
    assert plates is not None
    for seed in range(4):
        rows = heated_plates(seed, step)
        training = RowArrays(*(column[:1000] for column in rows))
        found = find_uncertain(plates, plates.output_names, training)
        assert {"wander Q1", "wander Q2"} <= {*found.names}
        model = replace_model(plates, uncertain=found.names)
        reference = ProcessReference.fit(model, plates.output_names, training, [max(step / 12.0**0.5, 1e-6)] * 2)
        largest.append(largest_in_averages(reference.run(rows)[1000:]))
    assert np.mean(largest) < 2.0


def heated_plates(seed: int, step: float, rows: int = 9000) -> RowArrays:
    """TCLab with a heater 2 % too strong; the power of both wanders by 0.9 % about what is recorded of it."""
    rng = np.random.default_rng(seed)
    kept = np.exp(-1.0 / 20.0)
    recorded = np.repeat(rng.uniform(10.0, 70.0, (rows // 150, 2)), 150, axis=0)
    wander = lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], rng.standard_normal((rows, 2)), axis=0)
    a = np.array([[-0.06, 0.01, 0, 0], [0.01, -0.06, 0, 0], [1 / 140, 0, -1 / 140, 0], [0, 1 / 140, 0, -1 / 140]])
    b = np.array([[204.0 / 5720.0, 0.0, 0.05], [0.0, 100.0 / 5720.0, 0.05], [0.0] * 3, [0.0] * 3])
    transition = expm(2.0 * np.block([[a, b], [np.zeros((3, 7))]]))[:4]
    x, measured = np.array([50.0, 35.0, 50.0, 35.0]), np.empty((rows, 2))
    for row, powers in enumerate(recorded + 0.9 * wander):
        measured[row] = x[2:]
        x = transition @ [*x, *powers, 21.0]
    measured += 0.043 * rng.standard_normal(measured.shape)
    shown = np.floor(measured / step) * step if step else measured
    return RowArrays(np.arange(rows) / 30.0, recorded, shown)


def test_a_training_of_few_rows_is_left_as_it_is() -> None:
    rows = RowArrays(np.arange(20.0), np.zeros((20, 1)), np.zeros((20, 2)))
    assert find_uncertain(cstr(), ("C", "T"), rows) == Uncertain()


def test_uncertainty_is_stated_in_words() -> None:
    assert describe_uncertain(("constant volume", "wander T", "wander qc", "noise C"), ("qc",)) == (
        "a disturbance of the balance of T wanders, qc wanders about its recorded value, the noise of C has memory, "
        "limits allow for what the training leaves open of the constants"
    )


UNCERTAIN = ("constant temperature_bias", "constant volume", "constant valve_lag")
QUICK = MonitorConfig(training_min=20.0, isolation=False)


def messages_of(kind: Kind, moves: int, seed: int, span_min: float) -> list[Encoded]:
    """Messages of the first minutes of a plant."""
    record = simulate(kind, (WIDE, RARE, LITTLE)[moves], seed)
    rows = record.time_min < span_min
    return list(samples(record.time_min[rows], {name: item[rows] for name, item in record.columns.items()}))


def find(uncertain: tuple[str, ...]) -> Callable[[DiagnosisJob], Finding]:
    """Diagnosis that finds these additional states."""
    model = msgspec.json.encode(ExtendedModel("cstr", uncertain=uncertain).to_object()).decode()
    return lambda job: Finding(job.first_ns, NOMINAL, "limits allow for it", model)


def test_a_valve_lag_that_the_training_could_not_show_raises_no_alarm() -> None:
    """The first move is at 75 min."""
    messages, raised = messages_of(KIND["valve lag of 0.12 min"], 1, 111, 160.0), []
    for model in (replace_model(cstr(), uncertain=UNCERTAIN), cstr()):
        found = backtest.run(messages, replace(QUICK, diagnose_training=False), model=model)
        raised.append(len(found.raised_alarms))
    assert raised[0] == 0
    assert raised[1] >= 1


@pytest.mark.parametrize("uncertain", [UNCERTAIN, ("wander T", "noise C")])
def test_a_monitor_with_additional_states_resumes_bit_for_bit(uncertain: tuple[str, ...]) -> None:
    messages, monitor = messages_of(EXACT, 2, 12, 40.0), Monitor(QUICK, 0)
    first = publish(monitor, messages[: 3 * 202])
    assert monitor.pipeline.baselines.diagnosis_job is not None
    monitor.pipeline.baselines.on_finding(find(uncertain)(monitor.pipeline.baselines.diagnosis_job))
    first += publish(monitor, messages[3 * 202 : 3 * 300])
    (change,) = changes(first)
    assert all(item in change.model for item in uncertain)
    resumed = Monitor(QUICK, 0)
    resumed.from_bytes(monitor.to_bytes())
    assert publish(resumed, messages[3 * 300 :]) == publish(monitor, messages[3 * 300 :])


def test_the_power_is_stated_for_constants_that_rows_have_taught() -> None:
    noise = NoiseLevels((0.002, 0.3), (0.1, 0.2, 0.0, 0.0, 0.0, 0.0, 0.4))
    model = replace_model(cstr(), uncertain=(*UNCERTAIN, "wander T"))
    known, levels = ProcessReference(model, ("C", "T"), ProcessMemory(noise)).known_plant
    assert known.state_names == ("C", "T", "T.wander")
    assert levels == NoiseLevels((0.002, 0.3), (0.1, 0.2, 0.4))

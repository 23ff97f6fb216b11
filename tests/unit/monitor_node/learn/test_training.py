"""Training: a disturbed segment is excluded and reported, too many are refused, and the better reference is taken."""

import msgspec
import numpy as np
import pytest

from monitor_node.config import MonitorConfig

from ..watching import sound_run, watched

CONFIG = MonitorConfig(isolation=False)


def test_a_training_with_a_disturbed_segment_leaves_it_out_reports_it_and_monitors_as_well() -> None:
    time_min, columns = sound_run(150.0, seed=1)
    columns["T"][300:420] += 3.0
    run = watched(time_min, columns)
    (note,) = run.monitor.notes
    assert note.startswith("training: left out ")
    assert "T was off by +" in note
    clean = watched(*sound_run(150.0, seed=1))
    widths = [points[-1].upper_limit for points in (run.points("shewhart/T"), clean.points("shewhart/T"))]
    assert widths[0] == pytest.approx(widths[1], rel=0.05)
    assert run.raised == clean.raised == []


def test_a_training_of_which_too_much_is_disturbed_restarts() -> None:
    time_min, columns = sound_run(230.0, seed=2)
    columns["T"][550:1000] += 3.0
    run = watched(time_min, columns)
    assert run.monitor.notes[0] == "the training starts again: more than a third of it was disturbed in T"
    assert run.monitor.memory.watching_since_ns is not None
    assert run.monitor.memory.watching_since_ns / 60e9 == pytest.approx(200.0, abs=0.2)


def test_a_plant_that_never_rests_is_watched_after_the_third_training() -> None:
    """Its thermometer wanders by up to 12 K, 20 minutes at each place."""
    time_min, columns = sound_run(340.0, seed=3)
    columns["T"] += np.repeat(np.tile([-12.0, 6.0, 0.0, 12.0, -6.0], 4), 200)[: time_min.size]
    run = watched(time_min, columns)
    assert len([note for note in run.monitor.notes if "starts again" in note]) == 2
    assert run.monitor.phase == "watching"


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_moves_of_the_coolant_beyond_those_of_the_training_raise_no_alarm(seed: int) -> None:
    """Trained on 98 to 104 l/min, then run over 88 to 111, with steps and with a ramp."""
    from reactorwatch.process.library.cstr import cstr
    from reactorwatch.process.simulate import Simulator

    generator = np.random.default_rng(seed)
    time_min = np.arange(2500) / 10
    qc = np.repeat(generator.uniform(98, 104, 250), 10)
    qc[1100:1800] = np.repeat(generator.uniform(88, 111, 7), 100)
    qc[1800:] = np.linspace(90, 110, 700)
    outputs = Simulator(cstr()).run(time_min, qc, np.array([0.1, 438.54])).outputs
    outputs = outputs + generator.normal(size=outputs.shape) * (0.002, 0.3)
    run = watched(time_min, {"qc": qc, "C": outputs[:, 0], "T": outputs[:, 1]})
    assert run.raised == []
    arx = msgspec.structs.replace(CONFIG, reference="arx")
    judged = watched(time_min, {"qc": qc, "C": outputs[:, 0], "T": outputs[:, 1]}, arx)
    outside = [point for point in judged.points("shewhart/T") if not 97 < qc[round(point.time_ns / 6e9)] < 105]
    assert outside == []  # where it was not trained the identified model says nothing


def test_a_plant_that_is_not_the_reactor_is_watched_by_its_identified_model() -> None:
    """A second-order lag with a gain of its own on the reactor's signal names: its equations predict badly."""
    generator = np.random.default_rng(5)
    rows = 1600
    qc = np.repeat(generator.uniform(90, 111, rows // 10), 10)
    T = np.full(rows, 20.0)
    for k in range(2, rows):
        T[k] = 1.5 * T[k - 1] - 0.56 * T[k - 2] + 0.02 * qc[k - 1] + generator.normal() * 0.1
    config = MonitorConfig(outputs=("T",), isolation=False)
    columns = {"qc": qc, "T": T}
    run = watched(np.arange(rows) / 10, columns, config)
    assert run.monitor.phase == "watching"
    assert run.raised == []
    columns["T"][1400:] += 1.0
    late = watched(np.arange(rows) / 10, columns, config)
    assert late.raised
    assert 140.0 <= late.raised[0][1] <= 142.0


def test_irregular_rows_are_watched_by_the_process_model_and_refused_by_the_identified_one_with_the_reason() -> None:
    generator = np.random.default_rng(6)
    time_min, columns = sound_run(230.0, seed=6)
    time_min = time_min + generator.uniform(-0.03, 0.03, time_min.size)
    assert watched(time_min, columns).monitor.phase == "watching"
    refused = watched(time_min, columns, msgspec.structs.replace(CONFIG, reference="arx"))
    assert refused.monitor.phase == "training"
    assert "do rows come one by one period?" in refused.monitor.notes[0]


@pytest.mark.parametrize(
    "setting",
    [
        {"outputs": ("pH",), "priorities": {}, "reference": "process"},
        {"inputs": ("steam",), "reference": "process"},
    ],
)
def test_the_process_model_of_another_plant_is_refused_in_one_line(setting: dict[str, object]) -> None:
    from monitor_node.core import Monitor
    from reactorwatch.errors import InputError

    with pytest.raises(InputError, match="reference 'equations' needs the signals of cstr"):
        Monitor(MonitorConfig(**setting), 0)  # type: ignore[arg-type]


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize(("moves", "is_too_few"), [(0, False), (1, True), (4, True), (5, False), (40, False)])
def test_without_equations_a_training_with_few_moves_of_the_input_is_reported_not_to_keep_the_promise(
    moves: int, is_too_few: bool, noise: float
) -> None:
    """Noise of the recorded input about its level is no move, but an input that is noise alone moves."""
    generator = np.random.default_rng(moves)
    time_min = np.arange(1100) / 10
    u = np.where(np.arange(1100) * (moves + 1) // 1000 % 2, 1.0, 0.0)
    u[1000:] = u[999]
    y = np.zeros(1100)
    for row in range(1, 1100):
        y[row] = 0.8 * y[row - 1] + u[row - 1] + generator.normal(0.0, 0.05)
    config = MonitorConfig(
        process="", inputs=("qc",), outputs=("T",), priorities={}, smallest_sd={}, isolation=False, training_min=100.0
    )
    run = watched(time_min, {"qc": u + noise * generator.standard_normal(u.size), "T": y}, config)
    few = [note for note in run.monitor.notes if "too few moves of qc" in note]
    assert bool(few) == is_too_few
    if is_too_few:
        assert f"qc ({moves}; 5 are needed)" in few[0]
        assert run.monitor.promise is not None
        assert not run.monitor.promise.kept

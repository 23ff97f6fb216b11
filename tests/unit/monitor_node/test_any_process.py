"""A process that no catalogue has gets what the reactor gets: diagnosed training, causes, power; live and later.

It has three states, one of them not measured, and two inputs (`tests.cascade`).
"""

import pickle
import re
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import msgspec
import numpy as np
import pytest

import reactorwatch as rw
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.diagnosis_worker import DiagnosisWorker, find_deviations
from monitor_node.learn.training_diagnosis import FAILED
from monitor_node.node import MonitorNode
from monitor_node.replay.verification import verify
from monitor_node.watch.baselines import ANSWER_ROWS
from monitor_node.watched_process import load_process
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import Encoded, Publication, decode, encode
from reactorwatch.contract.messages_pb2 import Baseline, Incident, Promise
from reactorwatch.description.read import find_process
from reactorwatch.diagnosis.report import panels
from reactorwatch.errors import InputError
from reactorwatch.records.record import Record
from reactorwatch.runtime.jobs import ProcessExecutor, SerialExecutor
from recorder.tools.player import samples_of
from tests import cascade
from tests.cascade import DESCRIBED, FORMS, USUAL, simulate, write_forms

TRAINING, FAULT, ROWS, START_NS = 250, 320, 450, 1_750_000_000 * 10**9

Executor = Callable[[], SerialExecutor | ProcessExecutor]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("cascade")
    write_forms(made)
    return made


@pytest.fixture(scope="module")
def warm() -> Record:
    """A feed 3 K warmer all along, as the equations do not have it, and a tenth less heating from a row on."""
    return simulate(ROWS, 3, (0, "Tin", 21.0), (FAULT, "g", 0.9 * USUAL["g"]))


def settings(process: Path) -> MonitorConfig:
    return MonitorConfig(process=str(process), training_rows=TRAINING, plant="cascade")


@pytest.mark.parametrize("form", FORMS)
def test_a_back_test_finds_the_deviation_in_the_training_and_the_cause_of_the_alarm(
    folder: Path, warm: Record, form: str
) -> None:
    names = FORMS[form]
    found = rw.backtest(warm, process=folder / form, training_rows=TRAINING)
    assert found.baseline is not None
    assert f"({names['Tin']}, constant) of +3 " in found.baseline.why
    assert found.baseline.from_min == pytest.approx(0.1 * (TRAINING + ANSWER_ROWS))
    assert found.reference == "equations"
    assert names["g"] in [item.cause for item in found.alarms[0].suspect[:3]]
    assert found.alarms[0].raised_min >= 0.1 * FAULT
    smallest = {item.deviation: item.within_1_h for item in found.power if not item.profile}
    assert set(names.values()) <= set(smallest)
    assert 0.0 < (smallest[names["g"]] or 0.0) < 0.05


def test_a_training_adjusts_the_parameters_that_the_process_calls_uncertain(folder: Path) -> None:
    (folder / "roughly.toml").write_text(DESCRIBED.replace("sd = 0.0002", "sd = 0.01"))
    found = rw.backtest(simulate(ROWS, 3, (0, "k", 0.03)), process=folder / "roughly.toml", training_rows=TRAINING)
    assert found.baseline is not None
    (adjusted,) = re.findall(r"agrees with the equations; k is (\S+) 1/min", found.baseline.why)
    assert float(adjusted) == pytest.approx(0.03, rel=0.02)
    assert not found.alarms


@pytest.mark.parametrize(
    ("uncertain", "expected"),
    [
        ({"zz": 1.0}, r"settings \[monitor\]: uncertain must be of .*, got zz"),
        ({"k": 1.0}, "k must be at most its value"),
    ],
)
def test_what_the_settings_call_uncertain_is_checked_at_the_start(
    folder: Path, uncertain: dict[str, float], expected: str
) -> None:
    with pytest.raises(InputError, match=expected):
        load_process(MonitorConfig(process=str(folder / "plain.py"), uncertain=uncertain))


@pytest.mark.parametrize(
    ("acts_on", "value"), [("h", 0.3), ("Tin", 16.0), ("q", 0.9), ("k", 0.04), ("T2", 1.0), ("g", 0.4)]
)
@pytest.mark.parametrize("form", ["own.py", "plain.py"])
def test_each_kind_of_cause_is_among_the_first_three_suspects(
    folder: Path, form: str, acts_on: str, value: float
) -> None:
    record = simulate(ROWS, 4, (FAULT, acts_on, value))
    found = rw.backtest(record, process=folder / form, training_rows=TRAINING, diagnose_training=False)
    assert FORMS[form][acts_on] in [item.cause for item in found.alarms[-1].suspect[:3]]


def watch_live(monkeypatch: pytest.MonkeyPatch, process: Path, record: Record, make: Executor) -> list[Encoded]:
    """Messages of a plant and of its monitor, whose diagnosis of the training is done before the fault."""
    monkeypatch.setattr("monitor_node.node.DiagnosisWorker", lambda: DiagnosisWorker(make()))
    node, log, now_ns = MonitorNode(settings(process), START_NS), list[Encoded](), START_NS

    def note(published: Iterable[Publication]) -> None:
        log.extend(encode(item)._replace(received_ns=now_ns) for item in published)

    note(node.on_tick(now_ns))
    for number, item in enumerate(samples_of(record, "cascade", START_NS)):
        while number == 4 * (FAULT - 40) and node.monitor("cascade").pipeline.baselines.update.is_pending:
            time.sleep(0.05)
            now_ns += 100_000_000
            note(node.on_tick(now_ns))
        note([item])
        note(node.on_message(log[-1], now_ns))
    assert node.monitor("cascade").failures.by_stage == {}
    note(node.on_stop(now_ns))
    return log


@pytest.mark.parametrize(
    ("form", "make"),
    [
        pytest.param("own.py", lambda: ProcessExecutor(1), marks=pytest.mark.slow, id="own causes, in a process"),
        pytest.param("described.toml", SerialExecutor, id="generic causes"),
    ],
)
def test_so_does_a_live_monitor_and_its_recording_is_verified(
    folder: Path, warm: Record, monkeypatch: pytest.MonkeyPatch, form: str, make: Executor
) -> None:
    names, log = FORMS[form], watch_live(monkeypatch, folder / form, warm, make)
    messages = [decode(item.payload, item.encoding) for item in log]
    (change,) = [item for item in messages if isinstance(item, Baseline)]
    assert f"({names['Tin']}, constant) of +3 " in change.why
    assert f"{names['Tin']}:constant:" in msgspec.json.decode(change.model)["effects"][0]
    suspects = [item.suspects for item in messages if isinstance(item, Incident) and item.suspects]
    assert names["g"] in [item.cause for item in suspects[-1][:3]]
    power = [item.power for item in messages if isinstance(item, Promise)][-1]
    assert set(names.values()) <= {item.deviation for item in power}
    assert verify(lambda: log, settings(folder / form)).exact


def test_a_cause_that_its_file_lost_since_the_start_fails_the_diagnosis_in_a_line(
    folder: Path, warm: Record, tmp_path: Path
) -> None:
    """The file is read again where another process diagnoses."""
    (tmp_path / "own.py").write_text((folder / "own.py").read_text())
    config, model = load_process(settings(tmp_path / "own.py"))
    monitor = Monitor(config, START_NS, model=model)
    for item in list(samples_of(warm, "cascade", START_NS))[: 4 * (TRAINING + 2)]:
        monitor.on_message(encode(item), 0)
    job = monitor.pipeline.baselines.diagnosis_job
    assert job is not None
    (tmp_path / "own.py").write_text((folder / "own.py").read_text().replace('"fouling"', '"scale"'))
    finding = find_deviations(pickle.loads(pickle.dumps(job)))
    assert finding.verdict == FAILED
    assert finding.why.endswith("own.py must have the causes that it had when the monitor started, lacks fouling")


def test_with_generic_causes_beside_its_own_a_process_has_alarms_traced_to_both(folder: Path, tmp_path: Path) -> None:
    """None of its own causes is a bias of T1."""
    text = (folder / "own.py").read_text().replace("model, effects())", "model, effects(), generic=True)")
    (tmp_path / "both.py").write_text(text)
    record = simulate(ROWS, 5)
    record.columns["T1"][FAULT:] += 1.0
    found = rw.backtest(record, process=tmp_path / "both.py", training_rows=TRAINING, diagnose_training=False)
    assert "T1.bias" in [item.cause for item in found.alarms[-1].suspect[:3]]
    assert {"heating", "T1.bias"} <= {item.deviation for item in found.power}


@pytest.mark.slow
def test_what_its_equations_lack_is_found_as_a_law(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tank 1 loses heat above 38 degC, as if it boiled."""
    monkeypatch.setattr(cascade, "rates", boil(cascade.rates))
    found = rw.diagnose(simulate(900, 3), process=folder / "own.py")
    assert (found.verdict, found.location) == ("unknown", "tank1")
    assert found.law is not None
    assert found.law.formula == "b max(T1 - c, 0)"
    assert found.law.parameters["b"].value == pytest.approx(-0.5, rel=0.02)
    assert found.law.parameters["c"].value == pytest.approx(38.0, abs=0.1)
    for errors in found.gain.held_out.values():
        assert errors.rmse_after < 1.1 * errors.noise_sd < 0.1 * errors.rmse_before


def boil(rates: Callable[..., Array]) -> Callable[..., Array]:
    """Rates of the tanks with a loss of heat in tank 1 above 38 degC."""
    return lambda x, *given: rates(x, *given) - np.array([0.0, 0.5 * max(float(x[1]) - 38.0, 0.0), 0.0])


@pytest.mark.parametrize(
    ("level", "hidden"),
    [(8.0, "P.lag, P.delay, P.stiction"), (0.0, "P.gain, P.lag, P.delay, P.stiction, g.deviation")],
)
def test_an_input_that_never_moved_in_the_training_leaves_causes_that_cannot_be_seen(
    folder: Path, level: float, hidden: str
) -> None:
    """A lag of it; and where it was 0, a wrong gain, or another effect of it."""
    record = simulate(TRAINING + 20, 3, heating=level)
    found = rw.backtest(record, process=folder / "plain.py", training_rows=TRAINING, diagnose_training=False)
    (note,) = [note for note in found.notes if "never moved" in note]
    assert note == f"training: P ({level:g}) never moved, so these causes cannot be seen until it does: {hidden}"


def test_an_experiment_moves_the_input_that_separates_the_explanations(folder: Path) -> None:
    """The heating never moved, so a wrong gain of it and an offset are the same; the flow would not tell them apart."""
    found = rw.diagnose(simulate(600, 3, (300, "g", 0.65), heating=8.0), process=folder / "plain.py")
    names = {name for item in found.alternatives for name, _ in item.causes} | {item.cause for item in found.causes}
    assert {"P.gain", "P.offset"} <= names
    experiment = found.experiment
    assert experiment is not None
    assert experiment.signal == "P"
    assert isinstance(experiment.input, dict)
    assert [len(moves) > 1 for moves in (experiment.input["q"], experiment.input["P"])] == [False, True]
    assert {"P.gain", "P.offset"} <= set(experiment.separates)
    assert experiment.probability > 0.99
    model = find_process(folder / "plain.py").require_model()
    drawn = panels.experiment(experiment, model)
    assert drawn[0].title == "P, kW"

"""A black box judges where it is chosen, or where there are no equations."""

from itertools import pairwise

import msgspec
import numpy as np
import pytest

from benchmarks.harness.plants import sound_record
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.learn.black_box_reference import BlackBoxReference
from monitor_node.learn.references import COPY_ROWS
from monitor_node.replay import backtest
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Alarm, Quality, Sample
from reactorwatch.records.record import to_time_ns

from ..fleets import of_plant, stage_by_stage
from ..samples import leaking_run, samples

TRAINING_MIN = 60.0
BLACK_BOX = MonitorConfig(
    plant="x",
    reference="black-box",
    training_min=TRAINING_MIN,
    charts=("shewhart", "ewma", "cusum", "mewma"),
    false_alarms_per_30_days=30.0,
)
ONSET_MIN = 110.0


@pytest.fixture(scope="module")
def leak() -> list[Encoded]:
    return of_plant("x", samples(*leaking_run(-0.02, ONSET_MIN, 130.0, 5)))


def reference_of(monitor: Monitor) -> BlackBoxReference:
    reference = monitor.pipeline.evaluation.reference
    assert isinstance(reference, BlackBoxReference)
    return reference


@pytest.mark.parametrize("points", [True, False])
def test_a_row_in_one_compiled_step_gives_what_it_gives_stage_by_stage(leak: list[Encoded], points: bool) -> None:
    run = [message for k, message in enumerate(leak) if not 2700 <= k < 2703]  # a row is lost
    stepped, staged, steps = Monitor(BLACK_BOX, 0, points=points), stage_by_stage(BLACK_BOX, points=points), 0
    raised = 0
    for message in run:
        steps += stepped.pipeline.evaluation.is_ordinary
        publications = stepped.on_message(message, 0)
        assert publications == staged.on_message(message, 0)
        raised += any(isinstance(item.message, Alarm) for item in publications)
    assert steps > 1000
    assert raised
    assert stepped.to_bytes() == staged.to_bytes()
    assert stepped.pipeline.reference == "black-box"


def test_nothing_is_learned_while_an_alarm_is_active_and_what_was_learned_last_is_taken_back(
    leak: list[Encoded],
) -> None:
    monitor, history = Monitor(BLACK_BOX, 0, points=False), []
    for k, message in enumerate(leak):
        monitor.on_message(message, 0)
        if k % 3 == 2 and monitor.pipeline.reference:
            reference = reference_of(monitor)
            history.append((reference.parameters[0], monitor.alarms.has_unexplained))
    active = [is_active for _, is_active in history]
    first = active.index(True)
    assert first > ONSET_MIN * 10 - TRAINING_MIN * 10
    before, during = history[first - 1][0], history[first][0]
    assert not np.array_equal(before, during)
    older = [k for k in range(first) if np.array_equal(history[k][0], during)]
    assert older
    assert COPY_ROWS <= first - older[-1] <= 2 * COPY_ROWS
    for (one, was_active), (other, is_active) in pairwise(history[first:]):
        if was_active and is_active:
            np.testing.assert_array_equal(one, other)


def test_auto_takes_the_black_box_where_there_are_no_equations(leak: list[Encoded]) -> None:
    config = msgspec.structs.replace(BLACK_BOX, reference="auto", outputs=("C", "T"), inputs=("flow",))
    renamed = [message._replace(key=message.key.replace("sample/qc", "sample/flow")) for message in leak]
    result = backtest.run(renamed, config)
    assert result.reference == "black-box"
    raised_min = [alarm.raised_ns / 6e10 for alarm, _ in result.raised_alarms]
    assert raised_min
    assert ONSET_MIN < min(raised_min) < ONSET_MIN + 2.0


def noise_free(bias: float) -> list[Encoded]:
    """A reactor without noise, whose temperature is measured with a bias from `ONSET_MIN` on."""
    record = sound_record("mid", "none", 3, 200.0)
    columns = {name: np.array(values) for name, values in record.columns.items()}
    columns["T"][np.array(record.time_min) >= ONSET_MIN] += bias
    return of_plant("x", samples(np.array(record.time_min), columns))


NOISE_FREE = msgspec.structs.replace(BLACK_BOX, charts=("shewhart", "ewma", "mewma"), process="", smallest_sd={})


def test_errors_of_a_model_without_noise_raise_no_alarm_and_a_twentieth_of_the_usual_noise_is_seen_at_once() -> None:
    """A bias of 0.015 K; the usual noise of the thermometer is 0.3 K."""
    sound, biased = (Monitor(NOISE_FREE, 0, points=False) for _ in range(2))
    assert not raised_by(sound, noise_free(0.0))
    raised = raised_by(biased, noise_free(0.015))
    assert raised[0].time_ns < to_time_ns(ONSET_MIN + 1.0)
    (step,) = (alarm.text for alarm in raised if alarm.alarm == "shift/T")
    size = float(step.split("moved by +")[1].split()[0])
    assert 0.01 < size < 0.03  # a filter that ran away would say a hundred times as much
    reference = reference_of(sound)
    assert reference.errs
    assert any("the residuals are errors of the black box" in note for note in sound.notes)
    assert sound.promise is not None
    assert sound.promise.kept
    np.testing.assert_array_equal(reference.parameters[0], reference.model.theta.ravel())  # nothing is learned


def raised_by(monitor: Monitor, messages: list[Encoded]) -> list[Alarm]:
    published = [item.message for message in messages for item in monitor.on_message(message, 0)]
    return [item for item in published if isinstance(item, Alarm) and item.event == "raised"]


def test_a_model_that_errs_is_compiled_and_resumes_bit_for_bit() -> None:
    messages = noise_free(0.0)[:4500]
    stepped, staged, steps = Monitor(NOISE_FREE, 0, points=False), stage_by_stage(NOISE_FREE, points=False), 0
    for k, message in enumerate(messages):
        if k == 3000:
            stored, stepped = stepped.to_bytes(), Monitor(NOISE_FREE, 0, points=False)
            stepped.from_bytes(stored)
        steps += stepped.pipeline.evaluation.is_ordinary
        assert stepped.on_message(message, 0) == staged.on_message(message, 0)
    assert steps > 1000
    assert stepped.to_bytes() == staged.to_bytes()


def test_too_many_signals_are_judged_by_the_identified_models_and_the_reason_is_noted() -> None:
    rng = np.random.default_rng(1)
    outputs = tuple(f"y{k}" for k in range(12))
    time_min = np.arange(400) / 10

    def messages() -> list[Encoded]:
        good = Quality.QUALITY_GOOD
        return [
            encode(
                Publication(
                    keys.key("x", keys.SAMPLE, name),
                    Sample(time_ns=to_time_ns(minute), sequence=row, value=rng.normal(), unit="1", quality=good),
                )
            )
            for row, minute in enumerate(time_min.tolist())
            for name in ("u", *outputs)
        ]

    config = MonitorConfig(
        plant="x",
        inputs=("u",),
        outputs=outputs,
        reference="black-box",
        training_min=30.0,
        smallest_sd={},
        priorities={},
    )
    result = backtest.run(messages(), config)
    assert result.reference == "arx"
    assert any("a model of 12 outputs and 1 inputs needs" in note for note in result.notes)

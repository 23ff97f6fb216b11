"""A plant is judged by what its training was like, from the row that the change names: live, replayed and resumed."""

from array import array
from dataclasses import replace

import msgspec
import pytest

from monitor_node.core import Monitor
from monitor_node.diagnosis_worker import find_deviations
from monitor_node.learn.process_reference import ProcessReference
from monitor_node.learn.training_diagnosis import FAILED, DiagnosisJob, equations_text, read_equations
from monitor_node.replay import backtest
from monitor_node.replay.verification import verify
from monitor_node.watch.baselines import ANSWER_ROWS
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode, encode_message
from reactorwatch.contract.messages_pb2 import Baseline, BaselineCommand, Sample
from reactorwatch.diagnosis.result import NAMED, NOMINAL
from reactorwatch.errors import InputError
from reactorwatch.kalman.ekf_step import row_function
from reactorwatch.process.extended_model import ExtendedModel
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.model import fingerprint
from reactorwatch.records.record import MINUTE_NS

from ..warm_plant import CONFIG, GIVEN, LATE, TRAINED, Run, changes, plant, publish

START_NS = 1_750_000_000 * 10**9
SECOND_NS = 10**9


def test_a_diagnosis_of_the_training_finds_what_the_plant_was_before(warm: Run) -> None:
    assert warm.finding.verdict == NAMED
    (effect,) = msgspec.json.decode(warm.finding.equations)["effects"]
    assert effect.startswith("feed_temperature:constant:")
    assert float(effect.split(":")[2]) == pytest.approx(2.0, abs=0.15)
    assert "feed_temperature, constant) of +" in warm.finding.why


def test_the_second_training_of_a_kind_of_plant_makes_no_filter_again(warm: Run) -> None:
    monitor = Monitor(CONFIG, 0)
    publish(monitor, warm.messages[: TRAINED + 3])
    job = monitor.pipeline.baselines.diagnosis_job
    assert job is not None
    first, made = find_deviations(job), row_function.cache_info().misses
    assert find_deviations(job) == first
    assert row_function.cache_info().misses - made <= 3  # of the equations with what this training was like


def test_the_change_holds_from_the_next_row_on_and_is_published_with_its_time(warm: Run) -> None:
    (change,) = changes(warm.published)
    assert change.time_ns == 43_000_000_000 * 60
    assert (change.what, change.by, change.id) == ("diagnosed", "monitor", 1)
    assert change.model == warm.finding.equations
    assert (
        warm.published[[item.message for item in warm.published].index(change)].key == "reactor/cstr/baseline/monitor"
    )


def test_until_the_change_a_plant_is_judged_by_the_equations_as_given(warm: Run) -> None:
    given = publish(Monitor(GIVEN, 0), warm.messages)
    (change,) = changes(warm.published)

    def split(publications: list[Publication]) -> tuple[list[Publication], list[Publication]]:
        of_rows = [item for item in publications if "/estimate/" in item.key and not item.key.endswith("/arx")]
        before = [item for item in of_rows if item.message.time_ns < change.time_ns]
        return before, of_rows[len(before) + 4 :]  # two rows have no prediction: the filter starts again

    assert split(warm.published)[0] == split(given)[0]
    assert not any(item in split(given)[1] for item in split(warm.published)[1])


def test_a_replay_of_the_recorded_change_is_bit_identical(warm: Run) -> None:
    again = Monitor(CONFIG, 0)
    for change in changes(warm.published):
        again.schedule(change)
    assert publish(again, warm.messages) == warm.published


def test_a_given_model_with_effects_is_what_the_training_is_compared_with_on_the_clock_of_the_bus(warm: Run) -> None:
    """The plant was 2 K warmer since five minutes before its training, and its model has it."""
    monitor = Monitor(CONFIG, 0)
    publish(monitor, warm.messages[: TRAINED + 3])
    job = monitor.pipeline.baselines.diagnosis_job
    assert job is not None
    times = array("q", [START_NS + time_ns for time_ns in job.rows.times])
    known = parse_fault(f"feed_temperature:step:2@{START_NS / MINUTE_NS - 5}min")
    found = find_deviations(
        DiagnosisJob(
            msgspec.structs.replace(job.rows, times=times),
            job.signals,
            msgspec.json.encode(ExtendedModel("cstr", (known,)).to_object()).decode(),
        )
    )
    assert (found.first_ns, found.verdict, found.equations) == (START_NS, NOMINAL, "")


def test_a_change_whose_row_was_lost_holds_from_the_next_row_on(warm: Run) -> None:
    (change,) = changes(warm.published)
    again = Monitor(CONFIG, 0)
    again.schedule(change)
    (late,) = changes(publish(again, warm.messages[:LATE] + warm.messages[LATE + 3 :]))
    assert late.time_ns == change.time_ns + 6_000_000_000


def test_a_monitor_that_resumes_before_the_finding_continues_bit_for_bit(warm: Run) -> None:
    again = Monitor(CONFIG, 0)
    again.from_bytes(warm.pending)
    job = again.pipeline.baselines.diagnosis_job
    assert job is not None
    published = publish(again, warm.messages[TRAINED + 3 : LATE])
    again.pipeline.baselines.on_finding(warm.finding)
    published += publish(again, warm.messages[LATE:])
    assert published == warm.published[-len(published) :]


def test_a_monitor_that_resumes_after_the_change_continues_bit_for_bit_without_a_training(warm: Run) -> None:
    again = Monitor(CONFIG, 0)
    again.from_bytes(warm.changed)
    assert again.pipeline.baselines.diagnosis_job is None
    assert [again.baseline] == changes(warm.published)
    published = publish(again, warm.messages[LATE + 60 :])
    assert published == warm.published[-len(published) :]


def watch_with_answer_after(warm: Run, rows: int, *, stopped: bool = False) -> list[Publication]:
    """Publications where the diagnosis answers some rows after the training; stopped: the monitor resumes then."""
    monitor, answered = Monitor(CONFIG, 0), TRAINED + 3 * (1 + rows)
    published = publish(monitor, warm.messages[:answered])
    monitor.pipeline.baselines.on_finding(warm.finding)
    if stopped:
        state, monitor = monitor.to_bytes(), Monitor(CONFIG, 0)
        monitor.from_bytes(state)
        monitor.on_history_end()
    return published + publish(monitor, warm.messages[answered:])


def test_an_answer_within_the_allowed_rows_holds_from_the_same_row_on_whenever_it_comes(warm: Run) -> None:
    """So a back-test, where it is there at once, and live monitors publish the same, even after a restart."""
    at_once = publish(Monitor(CONFIG, 0, diagnose=lambda _: warm.finding), warm.messages)
    (change,) = changes(at_once)
    assert change.time_ns == (40 * 60 + 6 * ANSWER_ROWS) * SECOND_NS
    for rows, stopped in ((0, False), (4, True), (ANSWER_ROWS - 1, False)):
        assert watch_with_answer_after(warm, rows, stopped=stopped) == at_once


def test_a_later_answer_holds_from_the_next_row_on_which_a_replay_reads_from_the_recording(warm: Run) -> None:
    late = watch_with_answer_after(warm, ANSWER_ROWS + 5)
    (change,) = changes(late)
    assert change.time_ns == (40 * 60 + 6 * (ANSWER_ROWS + 6)) * SECOND_NS
    again = Monitor(CONFIG, 0)
    again.schedule(change)
    assert publish(again, warm.messages) == late


def test_a_training_on_another_record_is_judged_by_what_its_diagnosis_found_from_the_first_row_on(warm: Run) -> None:
    trained = backtest.train(warm.messages[:TRAINED], CONFIG)
    found = backtest.run(warm.messages[TRAINED:], CONFIG, trained=trained)
    assert found.baseline is not None
    assert not found.raised_alarms


@pytest.mark.parametrize("verdict", [NOMINAL, "unknown", FAILED])
def test_a_finding_without_a_cause_changes_nothing_and_is_noted_once_unless_nominal(warm: Run, verdict: str) -> None:
    finding = warm.finding._replace(verdict=verdict, why="so it is", equations="")
    monitor = Monitor(CONFIG, 0, diagnose=lambda _: finding)
    published = publish(monitor, warm.messages)
    assert published == publish(Monitor(GIVEN, 0), warm.messages)
    assert monitor.pipeline.baselines.diagnosis_job is None
    assert [note for note in monitor.notes if "so it is" in note] == monitor.notes[-1:] * (verdict != NOMINAL)


def test_a_finding_of_another_training_is_ignored(warm: Run) -> None:
    monitor = Monitor(CONFIG, 0)
    publish(monitor, warm.messages[: TRAINED + 3])
    monitor.pipeline.baselines.on_finding(warm.finding._replace(first_ns=warm.finding.first_ns + 1))
    assert monitor.pipeline.baselines.diagnosis_job is not None
    assert not changes(publish(monitor, warm.messages[TRAINED + 3 :]))


def test_without_the_setting_no_training_is_diagnosed(warm: Run) -> None:
    monitor = Monitor(GIVEN, 0)
    publish(monitor, warm.messages[: TRAINED + 3])
    assert monitor.memory.watching_since_ns is not None
    assert monitor.pipeline.baselines.diagnosis_job is None


def test_a_state_of_a_monitor_that_diagnoses_no_training_is_read_by_one_that_does(warm: Run) -> None:
    monitor = Monitor(GIVEN, 0)
    publish(monitor, warm.messages[: LATE + 60])
    again = Monitor(CONFIG, 0)
    again.from_bytes(monitor.to_bytes())
    assert publish(again, warm.messages[LATE + 60 :]) == publish(monitor, warm.messages[LATE + 60 :])


def test_a_model_that_the_catalogue_does_not_make_travels_with_its_equations() -> None:
    assert "equations" not in msgspec.json.decode(equations_text(cstr()))
    for other in (replace(cstr(), name="other"), replace(cstr(), breakpoints=("V",))):
        assert fingerprint(read_equations(equations_text(other))) == fingerprint(replace(other, effects=()))


def test_a_backtest_judges_a_sound_plant_by_what_it_was_before(warm: Run) -> None:
    found, given = backtest.run(warm.messages, CONFIG), backtest.run(warm.messages, GIVEN)
    assert found.baseline is not None
    assert found.trained_until_min is not None
    assert found.baseline.from_min == pytest.approx(found.trained_until_min + 0.1 * ANSWER_ROWS)
    assert given.baseline is None
    assert not found.raised_alarms
    assert given.samples == found.samples


def test_the_alarms_of_a_nominal_plant_are_the_same_with_the_diagnosis_and_without() -> None:
    messages = plant("coolant_flow:step:-0.05@45min")
    found, given = backtest.run(messages, CONFIG), backtest.run(messages, GIVEN)
    assert found.baseline is None
    assert given.raised_alarms
    assert found.alarm_messages == given.alarm_messages


@pytest.mark.parametrize("is_warm", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_disturbance_of_the_training_changes_no_model_and_a_lasting_deviation_beside_it_is_found(
    warm: Run, *, is_warm: bool
) -> None:
    """The thermometer reads 5 K too much for six minutes."""
    disturbed = list(warm.messages if is_warm else plant())
    for at in range(3 * 100 + 2, 3 * 160, 3):
        item = Sample.FromString(disturbed[at].payload)
        item.value += 5.0
        disturbed[at] = disturbed[at]._replace(payload=item.SerializeToString())
    monitor = Monitor(CONFIG, 0, diagnose=find_deviations)
    publish(monitor, disturbed)
    effects = [] if monitor.baseline is None else msgspec.json.decode(monitor.baseline.model)["effects"]
    assert [effect.split(":")[:2] for effect in effects] == [["feed_temperature", "constant"]] * is_warm
    assert any("in the course of a curve" in note or "no cause" in note for note in monitor.notes)


def recording(warm: Run, *, killed: bool = False) -> list[Encoded]:
    """Messages of the run; killed: the monitor is killed before the finding, and resumes from its state."""
    monitor, log = Monitor(CONFIG, START_NS), list[Encoded]()

    def publish_all(publications: list[Publication]) -> None:
        log.extend(encode(item)._replace(received_ns=START_NS) for item in publications)

    publish_all(monitor.on_tick(START_NS))
    for number, message in enumerate(warm.messages):
        if number == LATE and killed:
            state, monitor = monitor.to_bytes(), Monitor(CONFIG, START_NS + 60 * SECOND_NS)
            monitor.from_bytes(state)
            monitor.on_history_end()
            publish_all(monitor.on_tick(START_NS + 61 * SECOND_NS))
        if number == LATE:
            monitor.pipeline.baselines.on_finding(warm.finding)
        log.append(message._replace(received_ns=START_NS))
        publish_all(monitor.on_message(message, START_NS))
    publish_all(monitor.on_stop(START_NS + 120 * SECOND_NS))
    return log


@pytest.mark.parametrize("killed", [False, True])
def test_a_recording_with_a_change_of_the_model_is_verified_value_for_value(warm: Run, killed: bool) -> None:
    log = recording(warm, killed=killed)
    found = verify(lambda: log, CONFIG)
    assert found.exact, found.diff.differences[:3]
    assert (found.diff.counts["baseline"].recorded, found.diff.counts["baseline"].equal) == (1, 1)


def test_a_recording_without_the_change_is_not_reproduced(warm: Run) -> None:
    log = [message for message in recording(warm) if not message.key.endswith("/baseline/monitor")]
    assert not verify(lambda: log, CONFIG).exact


def test_a_recorded_change_whose_model_cannot_be_read_is_one_line(warm: Run) -> None:
    (change,) = changes(warm.published)
    change = Baseline(time_ns=change.time_ns, model=change.model[:-9])
    log = [
        encode(Publication(item.key, change)) if item.key.endswith("/baseline/monitor") else item
        for item in recording(warm)
    ]
    with pytest.raises(InputError, match=r"^the model of the baseline is not JSON: "):
        verify(lambda: log, CONFIG)


def test_a_restored_baseline_judges_by_its_own_equations_and_traces_alarms_to_causes(warm: Run) -> None:
    monitor = Monitor(CONFIG, 0)
    monitor.from_bytes(warm.changed)
    monitor.on_history_end()
    assert monitor.pipeline.baselines.equations is not None
    extended = fingerprint(monitor.pipeline.baselines.equations)
    assert extended != fingerprint(cstr())
    for what, first in (("relearn", LATE + 60), ("restore", LATE + 90)):
        command = BaselineCommand(what=what, by="Anna", why="a new feed, which was none")
        question = Encoded(keys.key(CONFIG.plant, keys.COMMAND, "baseline"), *encode_message(command))
        assert monitor.on_command(question, 0)[0].accepted
        publish(monitor, warm.messages[first : first + 30])
    reference = monitor.pipeline.evaluation.reference
    assert isinstance(reference, ProcessReference)
    assert fingerprint(reference.equations) == extended
    assert monitor.failures.by_stage == {}
    resumed = Monitor(CONFIG, 0)
    resumed.from_bytes(monitor.to_bytes())
    resumed.on_history_end()
    rest = warm.messages[LATE + 120 :]
    assert publish(resumed, rest) == publish(monitor, rest)

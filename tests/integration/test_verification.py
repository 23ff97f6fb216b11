"""The monitor's core reproduces its recorded output value for value, and every difference is reported."""

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from reactorwatch.cli.replay import run
from reactorwatch.contract import keys
from reactorwatch.contract.codec import decode, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, Estimate, Sample
from reactorwatch.errors import InputError
from reactorwatch.runtime.reorder_buffer import Gap
from reactorwatch.version import UNKNOWN, build_metadata, describe_build
from recorder import RecordedMessage
from recorder.files.copies import cut, recover, sample_window
from recorder.files.recording import GAP, Recording, gap_metadata
from recorder.files.writer import RecordingWriter

from .watched_hour import ROWS, START_NS, record_hour

Report = dict[str, Any]
Change = Callable[[RecordedMessage], RecordedMessage | None]


@pytest.fixture(scope="module")
def hour(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The hour in one file."""
    path = tmp_path_factory.mktemp("hour") / "run.mcap"
    record_hour(path, black_box_min=0.0).stop()
    return path


def verified(path: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, Report]:
    """The exit code, and the JSON object."""
    code = run(path, None, None, as_json=True)
    return code, json.loads(capsys.readouterr().out.splitlines()[-1])


def recorded(path: Path, kind: str) -> int:
    return sum(1 for entry in Recording(path).messages({kind}) if not entry.latched)


def events(path: Path) -> set[tuple[str, str]]:
    alarms = (decode(entry.payload, entry.encoding) for entry in Recording(path).messages({keys.ALARM}))
    return {(alarm.alarm, alarm.event) for alarm in alarms if isinstance(alarm, Alarm)}


def rewritten(path: Path, out: Path, change: Change) -> Path:
    """The recording with its messages changed; those for which None is returned are left out."""
    with RecordingWriter(out, Recording(path).metadata) as writer:
        for entry in Recording(path).messages():
            if (changed := change(entry)) is not None:
                writer.write(changed)
    return out


def first_after(path: Path, key: str, minutes: float) -> RecordedMessage:
    return next(
        e for e in Recording(path).messages() if e.key == key and e.publish_time_ns >= START_NS + minutes * 60e9
    )


def test_an_hour_with_faults_is_reproduced_value_for_value(hour: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, report = verified(hour, capsys)
    assert (code, report["exact"], report["rows"], report["differing"], report["after_the_end"]) == (
        0,
        True,
        ROWS,
        0,
        0,
    )
    assert report["kinds"] == [
        {"kind": kind, "recorded": recorded(hour, kind), "equal": recorded(hour, kind)}
        for kind in (keys.ALARM, keys.ALARM_KPIS, keys.CHART, keys.ESTIMATE, keys.INCIDENT, keys.MODEL, keys.PROMISE)
    ]


def test_commands_and_alarms_of_the_clock_are_reproduced_too(hour: Path) -> None:
    """Else the test before would prove less than it says."""
    assert {
        ("ewma/T", "raised"),
        ("ewma/T", "acknowledge"),
        ("mewma/all", "acknowledge"),
        ("shewhart/T", "shelve"),
        ("shewhart/T", "shelf time over"),
        ("silence/T", "raised"),
        ("silence/plant", "raised"),
        ("silence/plant", "cleared"),
    } <= events(hour)


def test_a_rotated_run_is_exact_as_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record_hour(tmp_path, rotate_min=0.2, black_box_min=0.0).stop()
    assert len(Recording(tmp_path).files) >= 4
    code, report = verified(tmp_path, capsys)
    assert (code, report["rows"], report["differing"]) == (0, ROWS, 0)


def test_its_second_file_alone_cannot_be_verified_and_the_reason_is_reported(tmp_path: Path) -> None:
    record_hour(tmp_path, rotate_min=0.5, black_box_min=0.0).stop()
    with pytest.raises(InputError, match=r"the monitor was running before this recording begins.*verify the folder"):
        run(Recording(tmp_path).files[1], None, None, as_json=False)


def test_a_recovered_run_is_exact_up_to_where_it_was_cut_off(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record_hour(tmp_path / "run.mcap", black_box_min=0.0).kill()
    recover(tmp_path / "run.mcap.part", tmp_path / "saved.mcap")
    code, report = verified(tmp_path / "saved.mcap", capsys)
    assert (code, report["differing"]) == (0, 0)
    assert ROWS - 10 < report["rows"] < ROWS + 1


def test_a_recording_that_ends_between_a_sample_and_its_results_is_exact(
    hour: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    last = list(Recording(hour).messages())[:-5][-1]
    cut_off = rewritten(
        hour, tmp_path / "x.mcap", lambda entry: entry if entry.log_time_ns < last.log_time_ns else None
    )
    more = rewritten(
        hour,
        tmp_path / "y.mcap",
        lambda e: e if e.log_time_ns < last.log_time_ns or keys.SAMPLE in e.key else None,
    )
    assert verified(cut_off, capsys)[0] == 0
    code, report = verified(more, capsys)
    assert (code, report["differing"]) == (0, 0)
    assert report["after_the_end"] > 0


OWN = build_metadata()
OTHER_BUILDS: dict[str, dict[str, str]] = {
    "another version": OWN | {"version": "0.2.0"},
    "another commit": OWN | {"commit": "0123456789abcdef0123456789abcdef01234567"},
    "before commits were stated": {"version": OWN["version"]},
}


def of_build(hour: Path, out: Path, build: dict[str, str], settings: str | None = None) -> Path:
    """The hour as another build would have recorded it."""
    metadata = {name: value for name, value in Recording(hour).metadata.items() if name not in OWN}
    metadata |= {} if settings is None else {"settings": settings}
    with RecordingWriter(out, metadata | build) as writer:
        for entry in Recording(hour).messages():
            writer.write(entry)
    return out


@pytest.mark.parametrize("build", OTHER_BUILDS)
def test_a_recording_of_another_build_is_reported_before_all_else_also_if_only_a_later_file_is_one(
    build: str, hour: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run"
    path.mkdir()
    of_build(hour, path / "1.mcap", OWN, "[monitor]\nkey_of_that_build = 1\n")
    of_build(hour, path / "2.mcap", OTHER_BUILDS[build])
    expected = f"recorded by another build, {describe_build(**({'commit': UNKNOWN} | OTHER_BUILDS[build]))}, "
    for as_json in (False, True):
        with pytest.raises(InputError, match="key_of_that_build"):
            run(path, None, None, as_json=as_json)
        printed = capsys.readouterr()
        assert expected in (printed.err if as_json else printed.out).splitlines()[0]


def test_a_verification_of_another_build_s_recording_states_it_in_its_first_note(
    hour: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, report = verified(of_build(hour, tmp_path / "other.mcap", OTHER_BUILDS["another commit"]), capsys)
    assert (code, report["exact"]) == (0, True)
    assert "another build" in report["notes"][0]
    assert not [note for note in verified(hour, capsys)[1]["notes"] if "build" in note]


def test_a_copy_of_a_part_states_the_build_that_recorded_it(hour: Path, tmp_path: Path) -> None:
    for name, build in OTHER_BUILDS.items():
        source = of_build(hour, tmp_path / f"{name}.mcap", build)
        cut(
            (source,),
            tmp_path / f"{name} cut.mcap",
            sample_window((source,), START_NS, START_NS + 300_000_000_000),
            Recording(source).metadata,
        )
        copied = Recording(tmp_path / f"{name} cut.mcap").metadata
        assert {key: copied[key] for key in OWN if key in copied} == build


def as_after_a_cut(hour: Path, out: Path, lost: Callable[[RecordedMessage], bool] = lambda _: False) -> Path:
    """The hour as a recorder has it whose link was down from 25 to 35 minutes, around the leak and its alarms.

    What it missed came afterwards, all of one kind after the other; but for what was lost.
    """
    begin_ns, end_ns = (first_after(hour, keys.key("cstr", keys.SAMPLE, "qc"), at).log_time_ns for at in (25.0, 35.0))
    entries = list(Recording(hour).messages())
    missed = [entry for entry in entries if begin_ns <= entry.log_time_ns < end_ns]
    gaps: Counter[str] = Counter()
    with RecordingWriter(out, Recording(hour).metadata) as writer:
        for entry in (entry for entry in entries if entry.log_time_ns < begin_ns):
            writer.write(entry)
        for entry in sorted(missed, key=lambda entry: entry.key.split("/")[2]):
            if lost(entry):
                gaps["/".join(entry.key.split("/")[:3])] += 1
            else:
                writer.write(entry._replace(log_time_ns=end_ns))
        for stream, count in gaps.items():
            writer.add_metadata(GAP, gap_metadata(Gap(stream, 1, 0, 0, count, end_ns)))
        for entry in (entry for entry in entries if entry.log_time_ns >= end_ns):
            writer.write(entry)
    return out


def test_what_was_recovered_after_a_cut_link_is_exact_whatever_the_order_of_the_kinds(
    hour: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut_link = as_after_a_cut(hour, tmp_path / "cut.mcap")
    kinds = [entry.key.split("/")[2] for entry in Recording(cut_link).messages()]
    assert kinds != [entry.key.split("/")[2] for entry in Recording(hour).messages()]
    code, report = verified(cut_link, capsys)
    assert (code, report["rows"], report["differing"]) == (0, ROWS, 0)


def test_samples_that_only_the_recorder_lost_make_a_difference_and_the_gap_is_reported_with_it(
    hour: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key, first = keys.key("cstr", keys.SAMPLE, "T"), START_NS + 26 * 60 * 10**9
    lost = as_after_a_cut(
        hour, tmp_path / "x.mcap", lambda e: e.key == key and first <= e.publish_time_ns < first + 10**10
    )
    code, report = verified(lost, capsys)
    assert (code, report["exact"]) == (1, False)
    assert report["differences"][0]["at_min"] == 26.0
    assert report["notes"][-1].startswith("2 messages of reactor/cstr/sample never reached this recording")


def test_each_message_of_the_monitor_that_the_recorder_lost_is_a_difference(
    hour: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    at_ns = START_NS + 26 * 60 * 10**9
    lost = as_after_a_cut(
        hour, tmp_path / "x.mcap", lambda e: f"/{keys.ESTIMATE}/" in e.key and e.publish_time_ns == at_ns
    )
    code, report = verified(lost, capsys)
    assert (code, report["differing"]) == (1, 4)  # of each output by the reference and by the identified model
    assert {item["what"] for item in report["differences"]} == {"not recorded"}
    assert report["notes"][-1].startswith("4 messages of reactor/cstr/estimate never reached this recording")


def test_a_sample_that_was_changed_in_its_last_digit_is_found_out(
    hour: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key = keys.key("cstr", keys.SAMPLE, "T")
    target = first_after(hour, key, 20.0)

    def change(entry: RecordedMessage) -> RecordedMessage:
        if entry != target:
            return entry
        sample = decode(entry.payload, entry.encoding)
        assert isinstance(sample, Sample)
        sample.value *= 1.0 + 1e-15
        return entry._replace(payload=encode_message(sample)[0])

    code, report = verified(rewritten(hour, tmp_path / "x.mcap", change), capsys)
    assert (code, report["exact"]) == (1, False)
    assert report["differences"][0]["at_min"] == 20.0


def test_an_estimate_that_was_changed_is_named_with_both_values(
    hour: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = first_after(hour, keys.key("cstr", keys.ESTIMATE, "T"), 25.0)

    def change(entry: RecordedMessage) -> RecordedMessage:
        if entry != target:
            return entry
        estimate = decode(entry.payload, entry.encoding)
        assert isinstance(estimate, Estimate)
        estimate.prediction = 438.0
        return entry._replace(payload=encode_message(estimate)[0])

    code, report = verified(rewritten(hour, tmp_path / "x.mcap", change), capsys)
    assert (code, report["differing"]) == (1, 1)
    difference = report["differences"][0]
    assert (difference["topic"], difference["at_min"]) == ("reactor/cstr/estimate/T", 25.0)
    assert (difference["what"], difference["recorded"]) == ("prediction", "438.0")


def test_an_alarm_that_was_taken_out_or_put_in_is_found_out(
    hour: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    alarm = first_after(hour, keys.key("cstr", keys.ALARM, "ewma/T"), 0.0)
    code, report = verified(rewritten(hour, tmp_path / "a.mcap", lambda e: None if e == alarm else e), capsys)
    assert (code, report["differing"], report["differences"][0]["what"]) == (1, 1, "not recorded")
    other = alarm._replace(key=alarm.key.replace("ewma", "cusum"))
    forged = rewritten(hour, tmp_path / "b.mcap", lambda e: e)
    with RecordingWriter(tmp_path / "c.mcap", Recording(forged).metadata) as writer:
        for entry in Recording(forged).messages():
            writer.write(entry)
            if entry == alarm:
                writer.write(other)
    code, report = verified(tmp_path / "c.mcap", capsys)
    assert (code, report["differing"], report["differences"][0]["what"]) == (1, 1, "not said again")


def test_a_monitor_that_was_restarted_is_verified_as_two_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record_hour(tmp_path / "run.mcap", restart_at=250, black_box_min=0.0).stop()
    code, report = verified(tmp_path / "run.mcap", capsys)
    assert (code, report["rows"], report["differing"]) == (0, ROWS, 0)
    assert "the monitor was started 2 times; 2 of these runs were verified" in report["notes"]


def test_a_cut_from_the_middle_is_reported_as_not_verifiable(hour: Path, tmp_path: Path) -> None:
    window = sample_window([hour], START_NS + 20 * 60 * 10**9, START_NS + 40 * 60 * 10**9)
    cut([hour], tmp_path / "cut.mcap", window, Recording(hour).metadata)
    with pytest.raises(InputError, match="was running before this recording begins"):
        run(tmp_path / "cut.mcap", None, None, as_json=False)


def test_people_are_shown_a_table_and_the_first_differences(
    hour: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(hour, None, None, as_json=False) == 0
    assert "are reproduced, value for value" in capsys.readouterr().out
    target = first_after(hour, keys.key("cstr", keys.ESTIMATE, "T"), 25.0)
    tampered = rewritten(hour, tmp_path / "x.mcap", lambda e: None if e == target else e)
    assert run(tampered, None, None, as_json=False) == 1
    said = capsys.readouterr().out
    assert "1 DIFFER" in said
    assert "25 min  reactor/cstr/estimate/T: not recorded" in said
    bare = tmp_path / "bare.mcap"
    with RecordingWriter(bare, {}) as writer:
        for entry in Recording(hour).messages():
            writer.write(entry)
    with pytest.raises(InputError, match=r"does not say how the monitor was set.*--config"):
        run(bare, None, None, as_json=False)
    (tmp_path / "settings.toml").write_text("[monitor]\ntraining_min = 15.0\n")
    assert run(bare, tmp_path / "settings.toml", None, as_json=False) == 0
    (tmp_path / "settings.toml").write_text("[monitor]\ntraining_min = 16.0\n")
    assert run(bare, tmp_path / "settings.toml", None, as_json=False) == 1

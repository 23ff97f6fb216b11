"""Lost messages are listed in the file, in what is derived from it, and in the recorder's health."""

from pathlib import Path

import pytest
from mcap.records import Metadata

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import QUALITY_GOOD, Sample
from reactorwatch.runtime.reorder_buffer import Gap
from recorder.config import RecorderConfig
from recorder.files.copies import Window, cut, recover
from recorder.files.metadata import GAP, gap_metadata, parse_gap
from recorder.recording_files import RecordingFiles
from recorder.tools.inspect import inspect

from .recording import SECOND, Fed, recorder

ALARMS = Gap("reactor/cstr/alarm", 2**64 - 1, 5, 9, 3, 20 * SECOND)


def sample(number: int) -> Publication:
    return Publication(
        keys.key("cstr", keys.SAMPLE, "T"), Sample(time_ns=number, sequence=number, quality=QUALITY_GOOD)
    )


@pytest.fixture
def fed(tmp_path: Path) -> Fed:
    """A recorder to which three alarms did not come, between two samples."""
    fed = recorder(tmp_path / "run.mcap", 10 * SECOND, black_box_min=0.0)
    fed.receive([sample(0)], SECOND)
    assert fed.node.on_gap(ALARMS, 20 * SECOND) == []
    fed.receive([sample(1)], SECOND)
    return fed


def test_a_gap_states_all_that_is_known_of_it() -> None:
    assert parse_gap(Metadata(GAP, gap_metadata(ALARMS))) == ALARMS
    assert gap_metadata(ALARMS)["noticed"] == "1970-01-01T00:00:20.000+00:00"
    assert parse_gap(Metadata(GAP, {"stream": "x"})) is None


def test_it_is_in_the_file_and_counted_as_lost(fed: Fed, tmp_path: Path) -> None:
    fed.stop()
    assert inspect(tmp_path / "run.mcap").gaps == (ALARMS,)
    assert inspect(tmp_path).gaps == (ALARMS,)
    assert fed.last_health().lost == 3


def test_samples_that_are_lost_are_counted_once_by_their_own_numbers(tmp_path: Path) -> None:
    fed = recorder(tmp_path / "run.mcap", 10 * SECOND, black_box_min=0.0)
    fed.receive([sample(0)], SECOND)
    fed.node.on_gap(Gap("reactor/cstr/sample", 1, 1, 4, 4, 20 * SECOND), 20 * SECOND)
    fed.receive([sample(5)], SECOND)
    fed.stop()
    assert fed.last_health().lost == 4


def test_recovery_and_merging_keep_it_and_a_cut_keeps_those_of_its_time(fed: Fed, tmp_path: Path) -> None:
    fed.stop()
    run = tmp_path / "run.mcap"
    (tmp_path / "cut_off.mcap").write_bytes(run.read_bytes()[:-1])
    recover(tmp_path / "cut_off.mcap", tmp_path / "saved.mcap")
    cut([run], tmp_path / "cut.mcap", Window((0, 2**63 - 1)), {})
    cut([run], tmp_path / "with.mcap", Window((11 * SECOND, 20 * SECOND)), {})
    cut([run], tmp_path / "without.mcap", Window((11 * SECOND, 19 * SECOND)), {})
    kept = {name: inspect(tmp_path / f"{name}.mcap").gaps for name in ("saved", "cut", "with", "without")}
    assert kept == {"saved": (ALARMS,), "cut": (ALARMS,), "with": (ALARMS,), "without": ()}


def test_what_the_files_before_hold_is_not_written_again_once(tmp_path: Path) -> None:
    first = recorder(tmp_path, 10 * SECOND, black_box_min=0.0)
    first.receive([sample(0), sample(1)], SECOND)
    first.stop()
    fingerprints = RecordingFiles(RecorderConfig(out=str(tmp_path))).fingerprints_since(0)
    assert len(fingerprints) == 3  # with its last report of health
    again = recorder(
        tmp_path, 30 * SECOND, fingerprints=fingerprints, fingerprints_until_ns=90 * SECOND, black_box_min=0.0
    )
    told = [encode(item) for item in (sample(0), sample(1), sample(1), sample(2))]
    for message in told:
        again.node.on_message(Encoded(*message[:3], 31 * SECOND), 31 * SECOND)
    path = again.files.path
    again.stop()
    assert path is not None
    assert inspect(path).overview.topics[told[0].key].count == 2

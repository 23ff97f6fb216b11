"""A recording in another program: Rerun's own converter decodes the messages by the schemas in the file.

What mcap-protobuf-support makes of them is in test_mcap_file.py.
"""

import subprocess
from collections.abc import Mapping
from typing import Any

import pytest
from rerun.chunk import RrdReader

from reactorwatch.contract.codec import decode
from reactorwatch.contract.messages_pb2 import Alarm, Estimate, Fault, Health, Sample
from recorder.files.writer import RecordingWriter
from recorder.view.viewer import viewer_program
from tests.unit.recorder import golden


@pytest.fixture(scope="module")
def converted(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, list[Any]]:
    """The golden run as `rerun mcap convert` reads it: decoded messages by topic."""
    folder = tmp_path_factory.mktemp("interchange")
    with RecordingWriter(folder / "run.mcap", {}) as writer:
        for entry in golden.entries():
            writer.write(entry)
    convert = [str(viewer_program()), "mcap", "convert", str(folder / "run.mcap"), "-o", str(folder / "run.rrd")]
    subprocess.run(convert, check=True, capture_output=True)
    reader = RrdReader(folder / "run.rrd")
    found: dict[str, list[Any]] = {}
    for chunk in reader.stream(store=reader.recordings()[0]).to_chunks():
        batch = chunk.to_record_batch()
        for name in (name for name in batch.schema.names if name.endswith(":message")):
            found.setdefault(str(chunk.entity_path), []).extend(batch.column(name).flatten().to_pylist())
    return found


def test_rerun_decodes_every_message_of_every_topic(converted: Mapping[str, list[Any]]) -> None:
    expected: dict[str, int] = {}
    for entry in golden.entries():
        expected[f"/{entry.key}"] = expected.get(f"/{entry.key}", 0) + 1
    assert {topic: len(found) for topic, found in converted.items()} == expected


@pytest.mark.parametrize(
    ("key", "kind", "fields"),
    [
        ("sample/T", Sample, ("time_ns", "sequence", "value", "unit")),
        ("estimate/C", Estimate, ("time_ns", "prediction", "residual", "unit")),
        ("alarm/shewhart/T", Alarm, ("time_ns", "alarm", "value", "limit", "text")),
        ("fault/coolant_flow", Fault, ("specification", "active", "onset_ns")),
        ("health/monitor", Health, ("node", "phase")),
    ],
)
def test_rerun_reads_the_values_that_were_recorded(
    converted: Mapping[str, list[Any]], key: str, kind: type, fields: tuple[str, ...]
) -> None:
    ours = [decode(item.payload, item.encoding) for item in golden.entries() if item.key.endswith(key)]
    assert all(isinstance(item, kind) for item in ours)
    theirs = converted[f"/reactor/cstr/{key}"]
    assert [[item[name] for name in fields] for item in theirs] == [
        [getattr(item, name) for name in fields] for item in ours
    ]


def test_rerun_names_the_values_of_enumerations(converted: Mapping[str, list[Any]]) -> None:
    assert {item["quality"]["name"] for item in converted["/reactor/cstr/sample/T"]} == {"QUALITY_GOOD"}
    states = [item["state"]["name"] for item in converted["/reactor/cstr/alarm/shewhart/T"]]
    assert states == ["ALARM_STATE_UNACKNOWLEDGED", "ALARM_STATE_RETURNED_UNACKNOWLEDGED"]

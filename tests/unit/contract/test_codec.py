"""The contract: messages decode as they were encoded, foreign ones are refused, and yesterday's bytes still read.

Key expressions match as in Zenoh.
"""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import reactorwatch.contract
from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import (
    MESSAGES,
    DecodeError,
    Publication,
    decode,
    encode,
    encoding_of,
    message_type,
)
from reactorwatch.contract.keys import matches

FOLDER = Path(reactorwatch.contract.__file__).parent

# Bytes as version 0.1.0 wrote them, in the order of the fields of messages.proto; never to be regenerated.
YESTERDAY = {
    "Sample": "0900e40b5402000000102a19c3f5285c8f687b4022014b2801",
    "Estimate": (
        "0900e40b540200000011000000000000f03f19000000000000e03f21000000000000d03f2900000000000008403100000000"
        "000010403a014b"
    ),
    "ChartPoint": "0900e40b540200000011000000000000f03f2100000000000008c02900000000000008403001",
    "Alarm": (
        "0900e40b5402000000120a73686577686172742f54180220032900e40b540200000039000000000000084041000000000000"
        "00404a014b520c0a015411000000000000f03f6206542069732031"
    ),
    "Fault": "0900e40b5402000000120c636f6f6c616e745f666c6f771a05783a793a7a20012900e40b5402000000",
}


def yesterday() -> dict[str, object]:
    """What those bytes meant."""
    t = 10_000_000_000
    return {
        "Sample": messages.Sample(time_ns=t, sequence=42, value=438.535, unit="K", quality=messages.QUALITY_GOOD),
        "Estimate": messages.Estimate(
            time_ns=t, prediction=1, residual=0.5, residual_sd=0.25, lower_limit=3, upper_limit=4, unit="K"
        ),
        "ChartPoint": messages.ChartPoint(time_ns=t, statistic=1, lower_limit=-3, upper_limit=3, out=True),
        "Alarm": messages.Alarm(
            time_ns=t,
            alarm="shewhart/T",
            state=messages.ALARM_STATE_UNACKNOWLEDGED,
            priority=messages.PRIORITY_HIGH,
            raised_ns=t,
            value=3,
            limit=2,
            unit="K",
            contributions=[messages.Contribution(signal="T", share=1)],
            text="T is 1",
        ),
        "Fault": messages.Fault(time_ns=t, cause="coolant_flow", specification="x:y:z", active=True, onset_ns=t),
    }


@pytest.mark.parametrize("name", YESTERDAY)
def test_bytes_of_yesterday_still_read(name: str) -> None:
    payload = bytes.fromhex(YESTERDAY[name])
    assert decode(payload, f"application/protobuf;reactorwatch.v1.{name}") == yesterday()[name]


@given(
    st.integers(-(2**63), 2**63 - 1),
    st.integers(0, 2**64 - 1),
    st.floats(allow_nan=False),
    st.text(max_size=10),
)
def test_a_sample_comes_back_as_it_went(time_ns: int, sequence: int, value: float, unit: str) -> None:
    sample = messages.Sample(time_ns=time_ns, sequence=sequence, value=value, unit=unit, quality=messages.QUALITY_GOOD)
    encoded = encode(Publication("reactor/cstr/sample/T", sample))
    assert decode(encoded.payload, encoded.encoding) == sample


def test_every_message_is_in_the_catalogue() -> None:
    declared = re.findall(r"^message (\w+)", (FOLDER / "messages.proto").read_text(), re.MULTILINE)
    parts = {"Parameter", "Check", "Contribution", "Suspect", "PriorityCount", "Power"}  # travel only within others
    assert {kind.DESCRIPTOR.name for kind in MESSAGES} == set(declared) - parts


def test_what_is_published_has_its_time_as_field_one() -> None:
    commands = {
        "SetInput",
        "InjectFault",
        "ClearFault",
        "CommandReply",
        "AlarmCommand",
        "ShelveAlarm",
        "ListAlarms",
        "BaselineCommand",
    }
    for kind in MESSAGES:
        if kind.DESCRIPTOR.name not in commands:
            assert kind.DESCRIPTOR.fields_by_number[1].name == "time_ns", kind


def test_an_encoding_names_its_message_and_no_other() -> None:
    for kind in MESSAGES:
        assert message_type(encoding_of(kind)) is kind
    assert message_type("application/protobuf") is None


@pytest.mark.parametrize(
    ("payload", "encoding", "reason"),
    [
        (b"", "application/json", "encoding"),
        (b"", "", "encoding"),
        (b"", "application/protobuf;reactorwatch.v2.Sample", "version"),
        (b"", "application/protobuf;reactorwatch.v1.Other", "encoding"),
        (b"\xff\xff\xff", "application/protobuf;reactorwatch.v1.Sample", "payload"),
    ],
)
def test_a_foreign_message_is_refused_with_a_reason(payload: bytes, encoding: str, reason: str) -> None:
    with pytest.raises(DecodeError) as caught:
        decode(payload, encoding)
    assert caught.value.reason == reason


def test_the_generated_classes_are_those_of_the_proto_file(tmp_path: Path) -> None:
    command = ["-m", "grpc_tools.protoc", "-I.", f"--python_out={tmp_path}", f"--pyi_out={tmp_path}", "messages.proto"]
    subprocess.run([sys.executable, *command], cwd=FOLDER, check=True)
    for name in ("messages_pb2.py", "messages_pb2.pyi"):
        assert (tmp_path / name).read_text() == (FOLDER / name).read_text(), f"{name} is stale: run make protobuf"


@pytest.mark.parametrize("name", ["", "a/b", "*", "-x", "a" * 65, "a b", "$", ".a"])
def test_a_plant_name_that_could_break_a_key_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="plant name must be"):
        keys.check_plant(name)


@pytest.mark.parametrize("name", ["cstr", "R-101", "site_2.line-3", "9"])
def test_a_plant_name_that_cannot_is_taken(name: str) -> None:
    assert keys.parse(keys.key(name, keys.SAMPLE, "T")) == (name, "sample", "T")


@pytest.mark.parametrize("key", ["", "reactor", "reactor/cstr/sample", "reactor//sample/T", "other/cstr/sample/T"])
def test_a_foreign_key_has_no_topic(key: str) -> None:
    assert keys.parse(key) is None


def test_a_payload_of_ten_megabytes_is_not_read() -> None:
    sample = messages.Sample(time_ns=1, unit="K" * 10_000_000, quality=messages.QUALITY_GOOD)
    with pytest.raises(DecodeError, match="a payload must have at most 1048576 bytes, got 100000") as refused:
        decode(sample.SerializeToString(), encoding_of(messages.Sample))
    assert refused.value.reason == "too_large"


@pytest.mark.parametrize(
    ("expression", "key", "expected"),
    [
        ("a/b", "a/b", True),
        ("a/*", "a/b", True),
        ("a/*", "a/b/c", False),
        ("a/**", "a/b/c", True),
        ("a/**", "a", True),
        ("**", "a/b", True),
        ("a/**/c", "a/c", True),
        ("a/**/c", "a/b/b/c", True),
        ("a/**/c", "a/b", False),
        ("a/b*", "a/bc", True),
        ("a.b/c", "aXb/c", False),
    ],
)
def test_key_expressions_match_as_in_zenoh(expression: str, key: str, expected: bool) -> None:
    """https://zenoh.io/docs/manual/abstractions/#key-expression."""
    import zenoh

    assert matches(expression, key) is expected
    if "b*" not in expression:  # Zenoh writes a part of a part as $*
        assert zenoh.KeyExpr(expression).intersects(zenoh.KeyExpr(key)) is expected

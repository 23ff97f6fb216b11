"""A sample of `make fuzz`: no input crashes a node, and no foreign message raises an alarm."""

from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks import fuzz
from monitor_node.core import Monitor
from reactorwatch.contract.codec import Encoded
from recorder.core import Recorder


def test_strange_messages_are_counted_one_by_one_and_raise_no_alarm() -> None:
    """As many are refused, late or twice there as were sent, and the alarms are those of a run without them."""
    found = fuzz.fuzz_messages(5000, seed=11)
    assert found["taken for the plant's"] == 0
    assert {"payload", "encoding", "unknown_signal", "out_of_place", "out_of_range", "too_large"} <= found.keys()


def test_strange_commands_are_answered_in_one_line() -> None:
    found = fuzz.fuzz_commands(1000, seed=12)
    assert found["refused"] + found["accepted"] == 2000
    assert found["refused"] > found["accepted"] > 0


def test_strange_stored_states_are_refused_in_one_line() -> None:
    assert fuzz.fuzz_states(200, seed=13)["refused"] == 200


def test_strange_settings_are_an_error_in_one_line_or_valid() -> None:
    found = fuzz.fuzz_settings(500, seed=14)
    assert found["errors"] + found["valid"] == 500
    assert found["valid"] > 0


@settings(max_examples=300)
@given(
    key=st.text(max_size=50) | st.sampled_from([f"reactor/cstr/sample/{signal}" for signal in ("qc", "C", "T")]),
    payload=st.binary(max_size=100),
    encoding=st.text(max_size=50) | st.just("application/protobuf;reactorwatch.v1.Sample"),
)
def test_any_bytes_on_any_key_are_counted(key: str, payload: bytes, encoding: str) -> None:
    message = Encoded(key, payload, encoding)
    monitor, recorder = Monitor(fuzz.MONITOR, 0), Recorder("cstr", 0)
    assert monitor.on_message(message, 1) == []
    assert monitor.intake.rejects.total + monitor.rows + len(monitor.intake.aligner.memory.pending) == 1
    assert recorder.on_message(message, 1) is not None

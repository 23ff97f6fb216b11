"""Messages as they come from Zenoh."""

from types import SimpleNamespace

import pytest
import zenoh

from reactorwatch.runtime.bus_zenoh.messages import MAX_KEY, SEQUENCE_ATTACHMENT, SampleReader


@pytest.mark.parametrize(("length", "is_numbered"), [(MAX_KEY, True), (MAX_KEY + 1, False), (60_000, False)])
def test_a_key_longer_than_any_of_the_contract_is_not_put_in_order(length: int, is_numbered: bool) -> None:
    """The names of streams are kept, so that a made-up key of 65,535 characters would take as many bytes."""
    sample = SimpleNamespace(
        key_expr="x" * length,
        encoding=zenoh.Encoding.ZENOH_BYTES,
        payload=zenoh.ZBytes(b"1"),
        attachment=zenoh.ZBytes(SEQUENCE_ATTACHMENT.pack(3, 4)),
    )
    publisher, message = SampleReader().read(sample, 5)  # type: ignore[arg-type]
    assert (publisher, message.payload, len(message.key)) == ((3, 4) if is_numbered else None, b"1", length)

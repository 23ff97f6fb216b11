"""Samples read from their bytes by compiled code: what protobuf reads, or nothing."""

from math import inf, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reactorwatch.contract.messages_pb2 import Alarm, Quality, Sample
from reactorwatch.contract.sample_bytes import parse_samples, read_sequence, unit_digest

SAMPLES = st.builds(
    Sample,
    time_ns=st.integers(-(2**63), 2**63 - 1),
    sequence=st.integers(0, 2**62),
    value=st.floats(),
    unit=st.text(max_size=200),
    quality=st.sampled_from([0, 1, 2, 3]),
)


@given(st.lists(SAMPLES, max_size=5))
def test_what_protobuf_wrote_is_read_as_it_was(samples: list[Sample]) -> None:
    found = parse_samples([sample.SerializeToString() for sample in samples])
    assert found.is_canonical.all()
    assert found.time_ns.tolist() == [sample.time_ns for sample in samples]
    assert found.sequence.tolist() == [sample.sequence for sample in samples]
    assert found.unit.tolist() == [unit_digest(sample.unit) for sample in samples]
    assert found.quality.tolist() == [sample.quality for sample in samples]
    np.testing.assert_array_equal(found.value, [sample.value for sample in samples])


@given(st.binary(max_size=60))
def test_of_any_bytes_only_what_protobuf_reads_the_same_is_taken(data: bytes) -> None:
    found = parse_samples([data])
    if found.is_canonical[0]:
        sample = Sample.FromString(data)
        np.testing.assert_array_equal(found.value, [sample.value])
        assert (found.time_ns[0], found.sequence[0]) == (sample.time_ns, sample.sequence)
        assert found.quality[0] == sample.quality or sample.quality not in Quality.values()


@pytest.mark.parametrize("value", [0.0, -0.0, nan, inf, 1e-310])
def test_each_value_is_itself(value: float) -> None:
    (found,) = parse_samples([Sample(value=value).SerializeToString()]).value
    assert np.float64(found).tobytes() == np.float64(value).tobytes()


def test_a_field_that_a_later_version_adds_is_left_to_protobuf() -> None:
    later = Sample(time_ns=1, value=2.0).SerializeToString() + bytes([0x30, 0x01])
    assert not parse_samples([later]).is_canonical[0]


def test_half_a_sample_is_left_to_protobuf() -> None:
    whole = Sample(time_ns=1, value=2.0, unit="K", quality=Quality.QUALITY_GOOD).SerializeToString()
    cuts = [whole[:end] for end in range(1, len(whole))]
    plain = parse_samples(cuts).is_canonical.tolist()
    assert plain == [end in (9, 18, 21) for end in range(1, len(whole))]  # between two fields


def test_another_message_is_no_plain_sample_unless_its_bytes_are_one() -> None:
    assert not parse_samples([Alarm(time_ns=1, alarm="ewma/T", text="x").SerializeToString()]).is_canonical[0]


@given(
    time_ns=st.integers(-(2**63), 2**63 - 1),
    sequence=st.integers(0, 2**64 - 1),
    value=st.floats(),
    quality=st.sampled_from(list(Quality.values())),
)
def test_the_number_of_one_sample_is_read_from_its_bytes(
    time_ns: int, sequence: int, value: float, quality: Quality
) -> None:
    sample = Sample(time_ns=time_ns, sequence=sequence, value=value, quality=quality, unit="K")
    assert read_sequence(sample.SerializeToString()) == sequence


@given(st.binary(max_size=40))
def test_any_other_bytes_have_a_number_or_none(data: bytes) -> None:
    assert read_sequence(data) >= 0

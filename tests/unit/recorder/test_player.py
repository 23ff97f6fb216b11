"""Playing back: what goes out, and when."""

import math
from collections.abc import Iterator

import numpy as np
import pytest

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.records.record import Record
from recorder.entry import Entry
from recorder.player import BATCH, EVERYTHING, Player, playable, samples_of
from tests.unit.recorder import golden

SECOND = 10**9


def at(*seconds: float) -> Iterator[Publication]:
    return (Publication("reactor/x/sample/T", messages.Sample(time_ns=round(second * SECOND))) for second in seconds)


def played(player: Player, start_ns: int = 0) -> list[tuple[float, float]]:
    """(clock, sample time) in seconds of each message, by a clock that jumps from tick to tick."""
    now = start_ns
    out: list[tuple[float, float]] = []
    while not player.finished:
        now = max(now, player.next_tick_ns())
        out += [(now / SECOND, publication.message.time_ns / SECOND) for publication in player.on_tick(now)]
    return out


@pytest.mark.parametrize(("rate", "clock"), [(1.0, [7, 8, 10, 17]), (2.0, [7, 7.5, 8.5, 12]), (math.inf, [7] * 4)])
def test_samples_go_out_at_the_pace_of_their_times(rate: float, clock: list[float]) -> None:
    assert played(Player(at(100, 101, 103, 110), rate), 7 * SECOND) == list(
        zip(clock, [100, 101, 103, 110], strict=True)
    )


def test_a_sample_that_is_older_than_the_one_before_goes_out_at_once_and_in_its_place() -> None:
    assert played(Player(at(0, 5, 3, 6), 1.0)) == [(0, 0), (5, 5), (5, 3), (6, 6)]


def test_a_player_that_was_held_up_catches_up() -> None:
    player = Player(at(0, 1, 2, 3), 1.0)
    assert len(player.on_tick(50 * SECOND)) == 1  # the play starts here
    assert len(player.on_tick(52 * SECOND + 1)) == 2
    assert not player.finished
    assert player.next_tick_ns() == 53 * SECOND


def test_the_loop_gets_a_word_in_between_batches() -> None:
    player = Player(at(*range(BATCH + 1)), math.inf)
    assert len(player.on_tick(5)) == BATCH
    assert player.next_tick_ns() <= 5
    assert len(player.on_tick(5)) == 1
    assert (player.finished, player.published) == (True, BATCH + 1)


def test_nothing_to_play_is_finished_at_once() -> None:
    assert Player(iter(()), 1.0).finished


def test_only_samples_go_out_unless_more_is_asked_for() -> None:
    kinds = {keys.parse(publication.key).kind for publication in playable(golden.entries())}  # type: ignore[union-attr]
    assert kinds == {keys.SAMPLE}
    more = list(playable(golden.entries(), kinds=EVERYTHING))
    assert [item.key for item in more] == [entry.key for entry in golden.entries() if keys.HEALTH not in entry.key]


def test_what_goes_out_is_what_was_recorded_byte_for_byte_under_the_name_asked_for() -> None:
    recorded = [entry for entry in golden.entries() if "/sample/" in entry.key]
    again = [encode(publication) for publication in playable(golden.entries(), "twin")]
    assert [message.payload for message in again] == [entry.payload for entry in recorded]
    assert [message.key for message in again] == [entry.key.replace("cstr", "twin") for entry in recorded]


def test_what_cannot_be_decoded_or_is_no_publication_is_left_out() -> None:
    strange = [
        Entry("reactor/cstr/sample/T", b"\xff\xff", "application/protobuf;reactorwatch.v1.Sample", 0, 0),
        Entry("reactor/cstr/sample/T", b"", "text/plain", 0, 0),
        Entry("reactor/cstr/sample/T", b"", "application/protobuf;reactorwatch.v1.SetInput", 0, 0),
        Entry("reactor", b"", "application/protobuf;reactorwatch.v1.Sample", 0, 0),
    ]
    assert list(playable(strange)) == []


def test_a_record_becomes_the_samples_of_a_plant() -> None:
    record = Record(
        np.array([0.1, 0.2]),
        {"qc": np.array([100.0, 101.0]), "C": np.array([np.nan, 0.2]), "T": np.array([438.0, 439.0])},
        "x",
    )
    samples = [(item.key, item.message) for item in samples_of(record, "p", zero_ns=1000)]
    assert [
        (key, body.time_ns, body.sequence, body.value, body.unit)
        for key, body in samples
        if isinstance(body, messages.Sample) and body.quality == messages.QUALITY_GOOD
    ] == [
        ("reactor/p/sample/qc", 6_000_001_000, 0, 100.0, "l/min"),
        ("reactor/p/sample/T", 6_000_001_000, 0, 438.0, "K"),
        ("reactor/p/sample/qc", 12_000_001_000, 1, 101.0, "l/min"),
        ("reactor/p/sample/C", 12_000_001_000, 0, 0.2, "mol/l"),
        ("reactor/p/sample/T", 12_000_001_000, 1, 439.0, "K"),
    ]


def test_a_row_in_which_nothing_was_measured_says_so() -> None:
    record = Record(np.array([0.1]), {"qc": np.array([np.nan]), "T": np.array([np.nan])}, "x")
    ((key, body),) = samples_of(record, "p")
    assert key == "reactor/p/sample/qc"
    assert isinstance(body, messages.Sample)
    assert (body.quality, math.isnan(body.value)) == (messages.QUALITY_BAD, True)


def test_it_takes_no_commands_and_listens_to_nothing() -> None:
    player = Player(at(1), 1.0)
    message = Encoded("reactor/x/command/y", b"", "")
    assert player.on_message(message, 0) == []
    assert not player.on_command(message, 0)[0].accepted
    assert player.on_stop(0) == []

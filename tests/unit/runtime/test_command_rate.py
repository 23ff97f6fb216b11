"""A flood of commands is refused beyond a rate, by name and in all, and occasional commands are still served."""

import pytest

from monitor_node.alarms.commands import ALL, MAX_NAMES, PER_NAME, CommandRateLimiter, sender_name
from reactorwatch.contract.codec import Encoded, encode_message
from reactorwatch.contract.messages_pb2 import AlarmCommand, ListAlarms

SECOND = 1_000_000_000


def count_obeyed(rate: CommandRateLimiter, names: list[str], now_ns: int = 0) -> int:
    """Number of the commands that are obeyed."""
    return sum(rate.check(name, now_ns) is None for name in names)


@pytest.mark.parametrize(
    ("names", "at_once"),
    [(["Anna"] * 3000, PER_NAME.at_once), ([str(n) for n in range(3000)], ALL.at_once), ([""] * 3000, ALL.at_once)],
    ids=["one name", "made-up names", "questions"],
)
def test_of_a_flood_as_many_are_taken_as_may_come_at_once(names: list[str], at_once: float) -> None:
    assert count_obeyed(CommandRateLimiter(), names) == at_once


def test_over_a_minute_the_rate_is_taken() -> None:
    rate = CommandRateLimiter()
    obeyed = sum(count_obeyed(rate, ["Anna"] * 50, second * SECOND) for second in range(60))
    assert obeyed == PER_NAME.at_once + 59 * PER_NAME.per_s


def test_one_person_s_flood_does_not_refuse_another_s_command() -> None:
    rate = CommandRateLimiter()
    assert count_obeyed(rate, ["Anna"] * 3000) == PER_NAME.at_once
    assert count_obeyed(rate, ["Ben"]) == 1


def test_questions_do_not_refuse_commands() -> None:
    rate = CommandRateLimiter()
    count_obeyed(rate, [""] * 3000)
    assert count_obeyed(rate, ["Ben"]) == 1


def test_a_clock_that_is_set_back_fills_no_bucket_and_ends_the_refusals() -> None:
    rate = CommandRateLimiter()
    count_obeyed(rate, ["Anna"] * 3000, 1000 * SECOND)
    assert count_obeyed(rate, ["Anna"], 0) == 0
    assert count_obeyed(rate, ["Anna"], SECOND) == 1


def test_made_up_names_take_no_memory() -> None:
    rate = CommandRateLimiter()
    for number in range(3 * MAX_NAMES):
        rate.check(str(number), number * SECOND)
    assert len(rate._names) == MAX_NAMES


def test_the_sender_is_the_name_in_the_command() -> None:
    assert sender_name(Encoded("k", *encode_message(AlarmCommand(alarm="x", by=" Anna ")))) == "Anna"
    assert sender_name(Encoded("k", *encode_message(ListAlarms()))) == ""
    assert sender_name(Encoded("k", b"?", "text/plain")) == ""

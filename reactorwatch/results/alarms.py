"""Alarms and suspects of results."""

from typing import ClassVar, Self

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.messages_pb2 import Alarm
from reactorwatch.records.record import to_minutes
from reactorwatch.results.base import Result
from reactorwatch.sentences.alarm import describe_suspect, priority_word


class Suspect(Result, frozen=True):
    """A cause that an alarm may come from.

    Attributes:
        cause: name in the catalogue, or `unknown`.
        probability: probability of the cause.
        text: meaning of its size in words; empty: not known.
    """

    cause: str
    probability: float
    text: str

    @classmethod
    def of(cls, message: messages.Suspect) -> Self:
        """The suspect of a message."""
        return cls(message.cause, message.probability, message.text)

    def __str__(self) -> str:
        return describe_suspect(self.cause, self.probability, self.text)


class Contribution(Result, frozen=True):
    """Contribution of a signal to an alarm.

    Attributes:
        signal: name of the signal.
        share: its share of all contributions.
    """

    signal: str
    share: float


class RaisedAlarm(Result, frozen=True):
    """An alarm of a back-test.

    Attributes:
        alarm: name of the alarm, `chart/signal`.
        priority: `low`, `medium`, `high` or `critical`.
        raised_min: minute in which it was raised.
        cleared_min: minute in which it was cleared; None: it is active at the end.
        signals: signals that contributed to it.
        contributions: share of each of them.
        suspect: likely causes, the likeliest first.
        message: the alarm as it was raised, with its newest suspects.
        cleared_ns: time at which it was cleared; None: it is active at the end.
    """

    alarm: str
    priority: str
    raised_min: float
    cleared_min: float | None
    signals: list[str]
    contributions: list[Contribution]
    suspect: list[Suspect]
    message: Alarm
    cleared_ns: int | None

    python_only: ClassVar = ("message", "cleared_ns")

    @classmethod
    def of(cls, message: Alarm, cleared_ns: int | None, zero_ns: int) -> Self:
        """The alarm of a message; minutes are counted from `zero_ns`."""
        return cls(
            alarm=message.alarm,
            priority=priority_word(message.priority),
            raised_min=to_minutes(message.raised_ns, zero_ns),
            cleared_min=None if cleared_ns is None else to_minutes(cleared_ns, zero_ns),
            signals=[item.signal for item in message.contributions],
            contributions=[Contribution(item.signal, item.share) for item in message.contributions],
            suspect=[Suspect.of(item) for item in message.suspects],
            message=message,
            cleared_ns=cleared_ns,
        )

"""Alarms and suspects of results."""

from collections.abc import Sequence
from typing import ClassVar, Self

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.alarm_states import Event
from reactorwatch.contract.messages_pb2 import Alarm
from reactorwatch.contract.suspects import set_suspects
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


def raised_alarms(changes: Sequence[Alarm], incidents: Sequence[messages.Incident], zero_ns: int) -> list[RaisedAlarm]:
    """Each alarm as raised, with its newest suspects.

    Args:
        changes: every change of an alarm, in order.
        incidents: every change of an incident, in order.
        zero_ns: time from which minutes are counted.
    """
    alarms: list[tuple[Alarm, int | None]] = []
    last: dict[str, int] = {}
    newest = {message.number: message.suspects for message in incidents}
    for message in changes:
        if message.event == Event.RAISED:
            last[message.alarm] = len(alarms)
            alarm = Alarm()
            alarm.CopyFrom(message)
            alarms.append((alarm, None))
        elif message.alarm in last:
            alarm, cleared_ns = alarms[last[message.alarm]]
            if message.raised_ns == alarm.raised_ns and message.suspects:
                set_suspects(alarm, message.suspects)
            if cleared_ns is None and (message.cleared_ns or message.event == Event.CLEARED):
                cleared_ns = message.cleared_ns
            alarms[last[message.alarm]] = (alarm, cleared_ns)
    for alarm, cleared_ns in alarms:
        if cleared_ns is None and not alarm.names_cause:
            set_suspects(alarm, newest.get(alarm.incident, ()))
    return [RaisedAlarm.of(alarm, cleared_ns, zero_ns) for alarm, cleared_ns in alarms]

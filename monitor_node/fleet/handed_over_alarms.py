"""What was said of the alarms of a fleet's plants by who watched them before.

Monitors of a fleet hear each other's alarms. Who takes a plant over finds again what the one before had found, as far
as its state does not know it; what was said already is left out. An alarm was said if something was said of it at its
time or later, but for the end of a silence, which may be at the time at which it was raised.

The one before may have been ourselves: others may have watched the plant for a while, and we go on from their state.
"""

from collections.abc import Collection, Iterable

from monitor_node.alarms.states import Event
from monitor_node.replay.recorded_sessions import SILENCE
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode
from reactorwatch.contract.messages_pb2 import Alarm


class AlarmsBefore:
    """The newest of what was said of each alarm of plants, before they were ours to watch.

    Args:
        names: of the alarms that a plant may have; others are passed over.
    """

    def __init__(self, names: Collection[str]) -> None:
        self._names = frozenset(names)
        self._said: dict[str, dict[str, Alarm]] = {}  # by others, by plant and name
        self._ours: dict[str, dict[str, Alarm]] = {}  # by ourselves, until that has been passed

    def hear(self, plant: str, message: Encoded) -> None:
        """Note what another monitor says of an alarm of a plant."""
        alarm = alarm_of(message)
        if alarm is not None and alarm.alarm in self._names:
            self._said.setdefault(plant, {})[alarm.alarm] = alarm

    def of(self, plant: str) -> list[Alarm]:
        """What was said last of each alarm of a plant."""
        return list(self._said.get(plant, {}).values())

    def we_said(self, plant: str, alarms: Iterable[Alarm], last_ns: int | None) -> None:
        """Note that all that there is to say of a plant's alarms up to a row was said by ourselves.

        Args:
            plant: its name.
            alarms: as they were then.
            last_ns: time of that row; None: there was none.
        """
        for alarm in alarms:
            stands = alarm.raised_ns and not alarm.cleared_ns
            # Of a silence that another has raised by his clock rows tell nothing: only what was said of it was.
            judged_ns = last_ns if last_ns is not None and alarm.alarm != SILENCE else 0
            alarm.time_ns = max(judged_ns, alarm.raised_ns, alarm.cleared_ns)
            alarm.event = (Event.RAISED if stands else Event.CLEARED).value
            self._ours.setdefault(plant, {})[alarm.alarm] = alarm

    def passed(self, plant: str) -> None:
        """From now on what is found of a plant is later than all that we said before others watched it."""
        self._ours.pop(plant, None)

    def forget(self, plant: str) -> None:
        """Nothing was said of a plant."""
        self._said.pop(plant, None)
        self._ours.pop(plant, None)

    def silences_after(self, plant: str, known_ns: int) -> list[Alarm]:
        """The silence that was raised last, if it is later than any that is known: no sample tells of it again.

        Args:
            plant: its name.
            known_ns: when the last one was raised that is known.
        """
        said, ours = self._said.get(plant, {}).get(SILENCE), self._ours.get(plant, {}).get(SILENCE)
        over_ns = said.raised_ns if said is not None and said.event == Event.CLEARED.value else 0
        standing = [
            alarm
            for alarm in (said, ours)
            if alarm is not None and alarm.event == Event.RAISED.value and alarm.raised_ns > max(known_ns, over_ns)
        ]
        return sorted(standing, key=lambda alarm: alarm.raised_ns)[-1:]

    def new(self, publications: list[Publication]) -> list[Publication]:
        """Those publications that were not said before."""
        if not (self._said or self._ours) or not publications:
            return publications
        return [item for item in publications if not self._was_said(item)]

    def _was_said(self, publication: Publication) -> bool:
        alarm, topic = publication.message, keys.parse(publication.key)
        if not isinstance(alarm, Alarm) or topic is None:
            return False
        said = (before.get(topic.plant, {}).get(alarm.alarm) for before in (self._said, self._ours))
        return any(_covers(before, alarm) for before in said if before is not None)


def alarm_of(message: Encoded) -> Alarm | None:
    """What a message says of an alarm; None: nothing."""
    try:
        alarm = decode(message.payload, message.encoding)
    except DecodeError:
        return None
    return alarm if isinstance(alarm, Alarm) else None


def _covers(before: Alarm, alarm: Alarm) -> bool:
    ends_it = before.event == Event.RAISED.value and alarm.event == Event.CLEARED.value
    if alarm.time_ns == before.time_ns:
        return not ends_it  # a silence may end at the time at which it was raised
    return alarm.time_ns < before.time_ns

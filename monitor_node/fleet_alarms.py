"""What was said of the alarms of a fleet's plants by who watched them before.

Monitors of a fleet hear each other's alarms. Who takes a plant over finds again what the one before had found, as far
as its state does not know it; what was said already is left out. An alarm was said if something was said of it at its
time or later, but for the end of a silence, which may be at the time at which it was raised.
"""

from collections.abc import Collection

from monitor_node.alarm_states import Event
from monitor_node.recorded_lives import SILENCE
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
        self._said: dict[str, dict[str, Alarm]] = {}  # by plant and name

    def hear(self, plant: str, message: Encoded) -> None:
        """Note what another monitor says of an alarm of a plant."""
        try:
            alarm = decode(message.payload, message.encoding)
        except DecodeError:
            return
        if isinstance(alarm, Alarm) and alarm.alarm in self._names:
            self._said.setdefault(plant, {})[alarm.alarm] = alarm

    def of(self, plant: str) -> list[Alarm]:
        """What was said last of each alarm of a plant."""
        return list(self._said.get(plant, {}).values())

    def silences_after(self, plant: str, last_ns: int | None) -> list[Alarm]:
        """Silences that were raised after the last row that a state knows: no sample tells of them again.

        Args:
            plant: its name.
            last_ns: time of that row; None: it knows none.
        """
        return [
            alarm
            for alarm in self.of(plant)
            if alarm.alarm == SILENCE
            and alarm.event == Event.RAISED.value
            and (last_ns is None or alarm.raised_ns > last_ns)
        ]

    def new(self, publications: list[Publication]) -> list[Publication]:
        """Those publications that were not said before."""
        if not self._said or not publications:
            return publications
        return [item for item in publications if not self._was_said(item)]

    def _was_said(self, publication: Publication) -> bool:
        alarm, topic = publication.message, keys.parse(publication.key)
        if not isinstance(alarm, Alarm) or topic is None:
            return False
        before = self._said.get(topic.plant, {}).get(alarm.alarm)
        if before is None or alarm.time_ns > before.time_ns:
            return False
        ends_it = before.event == Event.RAISED.value and alarm.event == Event.CLEARED.value
        return alarm.time_ns < before.time_ns or not ends_it  # a silence may end at the time at which it was raised

"""Alarms that the previous owners of a fleet's plants published.

Monitors of a fleet subscribe to each other's alarms. A monitor that takes a plant over reproduces its predecessor's
alarms since the stored state; those that were published already are filtered out. An alarm was published if there is a
message on it of its time or later, except the end of a data timeout, which may be at the time at which it was raised.

The predecessor may have been this monitor: others may have owned the plant meanwhile, and it resumes from their state.
"""

from collections.abc import Collection, Iterable

from monitor_node.alarms.states import Event
from monitor_node.replay.recorded_sessions import TIMEOUT_ALARM
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, decode_as
from reactorwatch.contract.messages_pb2 import Alarm


class HandedOverAlarms:
    """The newest message on each alarm of plants, published before they were adopted.

    Args:
        names: names of the alarms of a plant; others are ignored.
    """

    def __init__(self, names: Collection[str]) -> None:
        self._names = frozenset(names)
        self._by_others: dict[str, dict[str, Alarm]] = {}  # by others, by plant and name
        self._ours: dict[str, dict[str, Alarm]] = {}  # by this monitor, until these rows have been processed again

    def on_message(self, plant: str, message: Encoded) -> None:
        """Record an alarm that another monitor published."""
        alarm = decode_as(message, Alarm)
        if alarm is not None and alarm.alarm in self._names:
            self._by_others.setdefault(plant, {})[alarm.alarm] = alarm

    def on_history(self, plant: str, messages: Iterable[Encoded]) -> None:
        """Record alarms from the publishers' caches, unless a later message on the same alarm arrived already."""
        for message in messages:
            alarm = decode_as(message, Alarm)
            known = self._by_others.get(plant, {}).get(alarm.alarm) if alarm is not None else None
            if alarm is not None and (known is None or alarm.time_ns >= known.time_ns):
                self.on_message(plant, message)

    def of(self, plant: str) -> list[Alarm]:
        """The newest message on each alarm of a plant."""
        return list(self._by_others.get(plant, {}).values())

    def publish_ours(
        self, plant: str, alarms: Iterable[Alarm], last_ns: int | None, withheld_ns: int | None = None
    ) -> None:
        """Record that this monitor published all alarms of a plant up to a row.

        Args:
            plant: name of the plant.
            alarms: alarms at that row.
            last_ns: time of the row; None: there was none.
            withheld_ns: time of the first change of an alarm that was not published; None: all were.
        """
        for alarm in alarms:
            if withheld_ns is not None:
                alarm.raised_ns = alarm.raised_ns if alarm.raised_ns < withheld_ns else 0
                alarm.cleared_ns = alarm.cleared_ns if alarm.cleared_ns < withheld_ns else 0
                last_ns = None if last_ns is None else min(last_ns, withheld_ns - 1)
            active = alarm.raised_ns and not alarm.cleared_ns
            # Rows do not show a data timeout that another monitor raised in receive time.
            evaluated_ns = last_ns if last_ns is not None and alarm.alarm != TIMEOUT_ALARM else 0
            alarm.time_ns = max(evaluated_ns, alarm.raised_ns, alarm.cleared_ns)
            alarm.event = (Event.RAISED if active else Event.CLEARED).value
            self._ours.setdefault(plant, {})[alarm.alarm] = alarm

    def expire(self, plant: str) -> None:
        """Drop this monitor's own messages on a plant: the rows to come are later."""
        self._ours.pop(plant, None)

    def remove(self, plant: str) -> None:
        """Remove a plant."""
        self._by_others.pop(plant, None)
        self._ours.pop(plant, None)

    def timeouts_after(self, plant: str, known_ns: int) -> list[Alarm]:
        """The newest active data timeout, if it is later than `known_ns`: no sample reproduces it.

        Args:
            plant: name of the plant.
            known_ns: time at which the last known one was raised.
        """
        theirs, ours = self._by_others.get(plant, {}).get(TIMEOUT_ALARM), self._ours.get(plant, {}).get(TIMEOUT_ALARM)
        published = [alarm for alarm in (theirs, ours) if alarm is not None]
        over_ns = [alarm.raised_ns for alarm in published if alarm.event == Event.CLEARED.value]
        active = [
            alarm
            for alarm in published
            if alarm.event == Event.RAISED.value and alarm.raised_ns > max(known_ns, *over_ns, 0)
        ]
        return sorted(active, key=lambda alarm: alarm.raised_ns)[-1:]

    def filter_new(self, publications: list[Publication]) -> list[Publication]:
        """Filter out publications that were published before."""
        if not (self._by_others or self._ours) or not publications:
            return publications
        return [item for item in publications if not self._was_published(item)]

    def _was_published(self, publication: Publication) -> bool:
        alarm, topic = publication.message, keys.parse(publication.key)
        if not isinstance(alarm, Alarm) or topic is None:
            return False
        published = (before.get(topic.plant, {}).get(alarm.alarm) for before in (self._by_others, self._ours))
        return any(_covers(before, alarm) for before in published if before is not None)


def _covers(before: Alarm, alarm: Alarm) -> bool:
    ends_it = before.event == Event.RAISED.value and alarm.event == Event.CLEARED.value
    if alarm.time_ns == before.time_ns:
        return not ends_it  # a data timeout may end at the time at which it was raised
    return alarm.time_ns < before.time_ns

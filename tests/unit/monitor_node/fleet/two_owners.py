"""Two monitors of a fleet, a plant, a folder and a bus, without clocks and threads: a test decides what happens when.

The second monitor takes over when the first one's token is gone, and gives the plant back when it returns. Each
receives everything in an inbox, and handles it whenever the test lets it. A monitor may be stalled in the middle of its
work: after it has evaluated, and before it publishes.
"""

from collections import deque
from collections.abc import Iterable

import msgspec

from monitor_node.core import Monitor
from monitor_node.fleet.monitor import FleetMonitor
from monitor_node.fleet.sharding import Shard, home_shard
from monitor_node.ingest.pending import PlantHistory
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Alarm, Sample

from ..fleets import QUICK, SECOND_NS, fleet, of_plant, shard_token
from ..samples import leaking_run, samples

PLANT, FIRST_ROW, ROWS, HISTORY_ROWS = "b", 298, 24, 5
AT_HOME = home_shard(PLANT, 2)

Published = tuple[str, str, int, int]
"""Alarm, event, time and time of raising."""


def leaking() -> list[Encoded]:
    """Rows of a plant that leaks, and stops sending for a while when the alarms are active."""
    messages = of_plant(PLANT, samples(*leaking_run(-0.2, 30.0, 36.0, 2)))
    return [shifted(message) if place >= 3 * (FIRST_ROW + 14) else message for place, message in enumerate(messages)]


def shifted(message: Encoded) -> Encoded:
    sample = Sample.FromString(message.payload)
    sample.time_ns += 240 * SECOND_NS
    return message._replace(payload=sample.SerializeToString())


def alone_from(state: bytes, messages: Iterable[Encoded]) -> list[Published]:
    """Alarms of a monitor that has the plant alone, and is never stopped."""
    monitor = Monitor(msgspec.structs.replace(QUICK, plant=PLANT), 0, points=False)
    monitor.from_bytes(state)
    monitor.on_history_end()
    return published_of(item for message in messages for item in monitor.on_message(message, 0))


def published_of(publications: Iterable[Publication]) -> list[Published]:
    messages = (item.message for item in publications)
    return [(m.alarm, m.event, m.time_ns, m.raised_ns) for m in messages if isinstance(m, Alarm)]


class Member:
    """One of the monitors."""

    def __init__(self, world: "World", name: str, number: int) -> None:
        self.world, self.name = world, name
        self.inbox: list[Encoded | tuple[str, bool] | PlantHistory] = []
        self.recovery = ""  # "requested", "claimed" or none
        self.read_version = 0
        self.published: list[Encoded] = []  # alarms, as its cache has them
        self.core: FleetMonitor = fleet(
            shard=Shard(number, 2),
            name=str(number),
            request_history=self.request,
            store=lambda _plant, state: self.put(state),
            claimed_elsewhere=self.is_claimed_elsewhere,
        )
        for token in (
            shard_token(3 - AT_HOME),
            *[shard_token(AT_HOME)] * world.is_alive,
            f"reactor/{PLANT}/alive/plant",
        ):
            self.core.on_alive(token, True, world.now_ns)

    def request(self, _plant: str, _taken_over: bool) -> bool:
        self.recovery = "requested"
        return True

    def is_claimed_elsewhere(self, _plant: str) -> bool:
        self.world.stall(self)
        return self.world.claimed_by not in ("", self.name)

    def put(self, state: bytes) -> None:
        if self.world.version == self.read_version:
            self.world.state, self.world.version = state, self.world.version + 1
            self.read_version = self.world.version
        else:
            self.core.rejoin(PLANT, self.world.now_ns)

    def publish(self, publications: list[Publication]) -> None:
        for item in publications:
            if isinstance(item.message, Alarm):
                self.world.published.append(item)
                self.published.append(encode(item))
                for member in self.world.members.values():
                    member.inbox.append(encode(item))

    def handle(self) -> None:
        """Handle the inbox: successive messages in one batch."""
        items, self.inbox = self.inbox, []
        batch: list[Encoded] = []
        for item in items:
            if isinstance(item, Encoded):
                batch.append(item)
                continue
            self.publish(self.core.on_messages(batch, self.world.now_ns))
            if isinstance(item, PlantHistory):
                self.publish(self.core.on_history(item, self.world.now_ns))
            else:
                self.publish(self.core.on_alive(*item, self.world.now_ns))
            batch = []
        self.publish(self.core.on_messages(batch, self.world.now_ns))

    def recover(self) -> None:
        """The next step of the recovery that was requested."""
        world = self.world
        if self.recovery == "requested":
            self.recovery = "claimed"
            if self.core.is_pending(PLANT):
                world.claimed_by = self.name
        elif self.recovery == "claimed":
            self.recovery, self.read_version = "", world.version
            known = [message for member in world.members.values() for message in member.published]
            self.inbox.append(PlantHistory(PLANT, world.state, world.history(), known))

    def store(self) -> None:
        """Store the plant's state, as the node does now and then."""
        if self.core.is_watched(PLANT) and not self.core.paused:
            self.put(self.core.state_of(PLANT))

    def pause(self) -> None:
        self.core.pause()

    def resume(self) -> None:
        if self.core.paused:
            is_lost = self.world.claimed_by not in ("", self.name) or self.world.version != self.read_version
            self.publish(self.core.resume([PLANT] if is_lost else [], self.world.now_ns))

    def tick(self) -> None:
        self.publish(self.core.on_tick(self.world.now_ns))


class World:
    """The plant, the bus, the folder and both monitors.

    Args:
        state: state of the plant at its first row here.
        rows: messages of all its rows.
        script: what happens, as `run` does it.
    """

    def __init__(self, state: bytes, rows: list[Encoded], script: Iterable[str]) -> None:
        self.state, self.version, self.claimed_by = state, 1, ""
        self.rows, self.sent = rows, 3 * FIRST_ROW
        self.script, self.stalled = deque(script), set[str]()
        self.now_ns = FIRST_ROW * SECOND_NS
        self.published: list[Publication] = []
        self.is_alive, self.stall_steps = True, 0
        self.members: dict[str, Member] = {}
        for name in ("first", "second"):
            self.start(name)
        self.members["first"].recover()
        self.members["first"].recover()
        self.members["first"].handle()

    def start(self, name: str) -> None:
        self.members[name] = Member(self, name, AT_HOME if name == "first" else 3 - AT_HOME)

    def history(self) -> list[Encoded]:
        return self.rows[3 * (FIRST_ROW - HISTORY_ROWS) : self.sent]

    def step(self, event: str) -> None:
        """One event: of the plant, of the first one's token, or of a monitor that is not stalled."""
        kind, _, name = event.partition(" ")
        if kind == "row":
            row = self.rows[self.sent : self.sent + 3]
            self.sent, self.now_ns = self.sent + len(row), self.now_ns + SECOND_NS
            for member in self.members.values():
                member.inbox += row
        elif kind == "second":
            self.now_ns += SECOND_NS
        elif kind == "token":
            self.is_alive = not self.is_alive
            for member in self.members.values():
                member.inbox.append((shard_token(AT_HOME), self.is_alive))
        elif kind == "stall":  # where the next monitor is about to publish
            self.stall_steps = int(name)
        elif kind == "kill" and name not in self.stalled:
            self.members[name].store()  # an alarm that is not stored yet is published again, unless another heard it
            self.kill(name)
        elif kind == "crash":
            self.kill(name)
        elif name not in self.stalled:
            getattr(self.members[name], kind)()

    def kill(self, name: str) -> None:
        """Kill a monitor and start it again; its token is noticed when it is shown again."""
        if name == "first" and self.is_alive:
            self.step("token")
        self.start(name)

    def stall(self, member: Member) -> None:
        """Stall a monitor for the next events."""
        steps, self.stall_steps = self.stall_steps, 0
        self.stalled.add(member.name)
        for _ in range(steps):
            if self.script:
                self.step(self.script.popleft())
        self.stalled.discard(member.name)

    def run(self) -> list[Published]:
        """Run the script, and then let all be done that is still to be done; returns the published alarms."""
        while self.script:
            self.step(self.script.popleft())
        self.stall_steps = 0
        if not self.is_alive:
            self.step("token")
        for rows_left in (2, 0):  # the last rows end what the history left open
            while self.sent < len(self.rows) - 3 * rows_left:
                self.step("row")
            for _ in range(20):
                for member in self.members.values():
                    member.resume()
                    member.recover()
                    member.handle()
        return published_of(self.published)

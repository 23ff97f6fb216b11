"""Publisher of garbage in a soak, from a seed, in a process of its own; started by `site`.

It begins with the first line of the input, goes on slowly, and floods at every line after that: random and mutated
samples on the keys of the plants, under encodings and with attachments of any kind, on keys of signals and plants that
are none, on the keys of alarms, and payloads of 10 MB. Samples are mutated from the first sample of a plant, long
before: a publisher with the keys, numbers and times of the plant is the plant.
"""

import sys
import threading
from typing import Any

import msgspec
import zenoh

from benchmarks.fuzz import Mutator
from benchmarks.harness.site import connect_client
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode, encoding_of
from reactorwatch.contract.messages_pb2 import Alarm, Quality, Sample
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.node_main import configure_log

PAUSE_S = 0.05
AT_A_TIME = 10
FLOOD = 20_000
LARGE = 2
LARGE_BYTES = 10_000_000
MADE_UP = 5
"""Names of plants that do not exist. Each costs a monitor: a fleet registers every plant whose samples arrive."""

SIGNALS = ("qc", "C", "T")


class Task(msgspec.Struct, frozen=True):
    """Task of the process."""

    seed: int  # seed of the messages
    plants: tuple[str, ...]  # names of the plants that it imitates
    zero_ns: int  # the time of their first row
    bus: BusConfig  # settings of the link to the router


class GarbageSource:
    """Publishes garbage."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self._bus = connect_client(task.bus)
        self._session: Any = self._bus._session
        self._mutator = Mutator(task.seed)
        self._heard = [
            encode(
                Publication(
                    keys.key(plant, keys.SAMPLE, signal),
                    Sample(time_ns=task.zero_ns, value=438.5, unit="K", quality=Quality.QUALITY_GOOD),
                )
            )
            for plant in task.plants
            for signal in SIGNALS
        ]
        self.published = 0

    def publish(self, count: int) -> None:
        """Publish a number of messages."""
        for _ in range(count):
            message = self._strange()
            attachment = self._mutator.draw.randbytes(16) if self._mutator.draw.random() < 0.1 else None
            self._session.put(
                message.key,
                message.payload,
                encoding=message.encoding,
                attachment=attachment,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
            self.published += 1

    def publish_large(self) -> None:
        """Publish payloads that are too large."""
        for _ in range(LARGE):
            self._session.put(self._mutator.draw.choice(self._heard).key, bytes(LARGE_BYTES))
            self.published += 1

    def _strange(self) -> Encoded:
        draw, base = self._mutator.draw, self._mutator.draw.choice(self._heard)
        match draw.randrange(10):
            case 0:
                return base._replace(
                    key=keys.key(draw.choice(self._task.plants), keys.SAMPLE, f"x{draw.randrange(100)}")
                )
            case 1:
                return base._replace(
                    key=keys.key(f"absent{draw.randrange(MADE_UP)}", keys.SAMPLE, draw.choice(SIGNALS))
                )
            case 2:
                key = keys.key(
                    draw.choice(self._task.plants), keys.ALARM, draw.choice(("ewma/T", "x", "silence/plant"))
                )
                return Encoded(key, draw.randbytes(draw.randrange(100)), encoding_of(Alarm))
            case _:
                message = self._mutator.message(self._heard)
                return message._replace(key=base.key)  # the keys that the mutator makes are not all of Zenoh's


def main(task: Task) -> None:
    """Publish garbage until the input ends; then print the number of messages."""
    source = GarbageSource(task)
    ended, floods = threading.Event(), threading.Semaphore(0)

    def read() -> None:
        for _ in sys.stdin:
            floods.release()
        ended.set()
        floods.release()

    threading.Thread(target=read, daemon=True).start()
    print("ready", flush=True)
    floods.acquire()  # the first line: the plants are known by now
    while not ended.wait(PAUSE_S):
        source.publish(AT_A_TIME)
        if floods.acquire(blocking=False):
            source.publish(FLOOD)
            source.publish_large()
            print("flooded", flush=True)
    print(source.published, flush=True)


if __name__ == "__main__":
    configure_log()
    main(msgspec.json.decode(sys.argv[1], type=Task))

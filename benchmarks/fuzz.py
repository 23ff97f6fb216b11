"""Fuzz test: no message, command, state or setting makes a node fail or raise a false alarm.

Random and mutated messages are put between the samples of a sound plant and fed to the cores of monitor and recorder,
mutated commands to monitor and plant, mutated bytes to what reads a stored state, and mutated settings to what reads
settings files. Nothing may raise, what is refused must be counted or answered in one line, and the monitor must say of
its alarms what it says without all this.

    python benchmarks/fuzz.py [how many of each]
"""

import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from plant_node.config import PlantConfig
from plant_node.node import PlantNode
from plant_node.record import plant_from, simulate_record
from reactorwatch.cli.processes import settings_text
from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import MESSAGES, Encoded, Publication, encode, encode_message, encoding_of
from reactorwatch.errors import InputError
from reactorwatch.runtime.config import SECTIONS, BusConfig, read_settings, section
from recorder.config import RecorderConfig
from recorder.core import Recorder
from recorder.tools.player import samples_of

COUNT, COMMANDS, SETTINGS, STATES = 200_000, 20_000, 20_000, 5_000
BETWEEN = 5
"""Strange messages for each row of the plant."""

PLANTS = 0.1
"""Share of the valid settings from which a plant is made: that takes a while."""

MONITOR = MonitorConfig(training_min=20.0)
SPECIAL = (0.0, -0.0, 1.0, -1.0, 438.5, 1e-300, 1e15, 1e30, 1e300, float("nan"), float("inf"), -float("inf"))
NUMBERS = (0, 1, 2, 255, 2**31, 2**32, 2**53, 2**62, 2**63 - 1, 2**64 - 1)
TABLES: dict[str, Any] = {"bus": BusConfig, "plant": PlantConfig, "monitor": MonitorConfig, "recorder": RecorderConfig}


class Mutator:
    """Makes random messages and mutates bytes."""

    def __init__(self, seed: int) -> None:
        self.draw = random.Random(seed)
        self._encodings = [encoding_of(kind) for kind in MESSAGES]

    def message(self, heard: list[Encoded]) -> Encoded:
        """A message that is like one of those heard before, or like none."""
        draw, base = self.draw, self.draw.choice(heard)
        match draw.randrange(8):
            case 0:
                return base._replace(payload=draw.randbytes(draw.choice((0, 1, 2, 8, 30, 60, 200, 2000))))
            case 1 | 2:
                return base._replace(payload=self.flip_bits(base.payload))
            case 3:
                return base._replace(payload=self.splice(base.payload, draw.choice(heard).payload))
            case 4:
                return base._replace(encoding=draw.choice((*self._encodings, self.text(base.encoding), "")))
            case 5:
                return base._replace(key=self.text(base.key))
            case 6:
                return base._replace(payload=self.sample(base).SerializeToString())
            case _:
                return base._replace(payload=b"\x08\x01" + base.payload)  # a field of another type

    def sample(self, base: Encoded) -> messages.Sample:
        """A well-formed sample; one, two or all of its fields are anything."""
        draw, sample = self.draw, messages.Sample.FromString(base.payload)
        for field in draw.sample(("time_ns", "sequence", "value", "unit", "quality"), draw.choice((1, 1, 2, 5))):
            anything: dict[str, Callable[[], Any]] = {
                "time_ns": lambda: draw.choice((draw.randrange(-(2**63), 2**63), -(2**63), 2**63 - 1, 0)),
                "sequence": lambda: draw.choice((draw.randrange(2**64), *NUMBERS)),
                "value": lambda: draw.choice((draw.gauss(0, 1e3), *SPECIAL)),
                "unit": lambda: "".join(chr(draw.randrange(1, 0xD7FF)) for _ in range(draw.choice((0, 1, 5, 500)))),
                "quality": lambda: draw.randrange(-5, 10),
            }
            setattr(sample, field, anything[field]())
        return sample

    def flip_bits(self, data: bytes) -> bytes:
        """Flip some bits."""
        changed = bytearray(data)
        for _ in range(self.draw.choice((1, 1, 1, 2, 8))):
            if changed:
                changed[self.draw.randrange(len(changed))] ^= 1 << self.draw.randrange(8)
        return bytes(changed)

    def splice(self, first: bytes, second: bytes) -> bytes:
        """Join the beginning of one and the end of another."""
        return first[: self.draw.randrange(len(first) + 1)] + second[self.draw.randrange(len(second) + 1) :]

    def text(self, text: str) -> str:
        """A text with some characters left out, doubled or replaced."""
        characters = list(text)
        for _ in range(self.draw.choice((1, 1, 2, 5))):
            place = self.draw.randrange(len(characters) + 1)
            anything = [chr(self.draw.choice((self.draw.randrange(32, 127), self.draw.randrange(1, 0xD7FF))))]
            characters[place : place + self.draw.randrange(3)] = anything * self.draw.randrange(3)
        return "".join(characters)

    def value(self) -> str:
        """A value as TOML writes it."""
        draw = self.draw
        numbers = [
            str(draw.choice((-1, 1)) * draw.choice((*NUMBERS, draw.randrange(1000)))),
            "1e400",
            "-0.0",
            "nan",
            "inf",
        ]
        others = ["true", '""', '"x"', f'"{self.draw.randrange(10**6)}"', "[]", "[1, 2]", '["C"]', "{}", "{ C = 1 }"]
        return draw.choice((*numbers, repr(draw.gauss(0, 10)), *others, "1979-05-27T07:32:00Z", "0x" + "f" * 400))

    def settings(self, text: str) -> str:
        """Settings with some lines mutated, doubled, left out or moved."""
        draw, lines = self.draw, text.splitlines()
        for _ in range(draw.choice((1, 1, 1, 2, 4))):
            place = draw.randrange(len(lines))
            match draw.randrange(5):
                case 0:
                    lines[place] = self.text(lines[place])
                case 1 | 2 if "=" in lines[place]:
                    lines[place] = lines[place].split("=")[0] + "= " + self.value()
                case 3:
                    lines.insert(draw.randrange(len(lines)), lines[place])
                case _:
                    lines[place] = "" if draw.random() < 0.5 else f"[{draw.choice((*SECTIONS, 'x'))}]"
        return "\n".join(lines)


def fuzz_messages(count: int, seed: int = 1) -> dict[str, int]:
    """Put strange messages between the samples of a sound plant; returns what became of them."""
    rows = max(count // BETWEEN, 400) + 1
    record = simulate_record(PlantConfig(seed=seed), rows)
    plant = [encode(item) for item in samples_of(record, MONITOR.plant, 0)]
    mutator = Mutator(seed)
    plain, monitor, recorder = Monitor(MONITOR, 0), Monitor(MONITOR, 0), Recorder(MONITOR.plant, 0)
    said: list[list[Encoded]] = [[], []]
    strange = 0
    for first in range(0, len(plant), 3):
        row = plant[first : first + 3]
        for watching, kept in zip((plain, monitor), said, strict=True):
            kept += [encode(item) for message in row for item in watching.on_message(message, first)]
        for _ in range(BETWEEN if first else 0):
            message = mutator.message(plant[max(0, first - 30) : first + 3])
            said[1] += [encode(item) for item in monitor.on_message(message, first)]
            recorder.on_message(message, first)
            strange += 1
        monitor.to_bytes() if first % 3000 == 0 else None
    alarms = [[item for item in kept if "/alarm/" in item.key] for kept in said]
    assert alarms[0] == alarms[1], "the alarms are others"
    health = _health(monitor.on_tick(2**62))
    _health([recorder.health(2**62)])
    assert health.received == len(plant) + strange
    counted = Counter(health.refused_by_reason) | Counter(duplicated=health.duplicated, late=health.late)
    waiting = sum(len(run.held) for run in monitor.memory.runs)
    taken = strange - counted.total() - waiting
    assert 0 <= taken <= strange // 1000, f"{taken} strange messages are not counted"
    return {
        "messages": strange,
        **dict(sorted(counted.items())),
        "taken for the plant's": taken,
        "alarms": len(alarms[1]),
    }


def _health(said: list[Publication]) -> messages.Health:
    found = [item.message for item in said if isinstance(item.message, messages.Health)]
    found[0].SerializeToString()
    return found[0]


def fuzz_commands(count: int, seed: int = 2) -> dict[str, int]:
    """Ask monitor and plant strange things; each must be answered, in one line."""
    mutator, told = Mutator(seed), Counter[str]()
    plant = PlantNode(plant_from(PlantConfig(seed=seed)), PlantConfig(seed=seed), _ignore)
    plant.on_tick(0)
    nodes: tuple[Any, ...] = (Monitor(MONITOR, 0), plant)
    commands = (
        ("acknowledge", messages.AlarmCommand(alarm="shewhart/T", by="Ada", comment="seen")),
        ("shelve", messages.ShelveAlarm(alarm="ewma/T", by="Ada", minutes=5.0)),
        ("list_alarms", messages.ListAlarms()),
        ("set_input", messages.SetInput(signal="qc", value=100.0, by="Ada")),
        ("inject_fault", messages.InjectFault(specification="coolant_flow:step:-0.05@1e9min", by="Ada")),
        ("clear_fault", messages.ClearFault(cause="coolant_flow", by="Ada")),
    )
    asked = [Encoded(keys.key(MONITOR.plant, keys.COMMAND, name), *encode_message(body)) for name, body in commands]
    for _ in range(count):
        base = mutator.draw.choice(asked)
        payload = mutator.flip_bits(base.payload) if mutator.draw.random() < 0.5 else base.payload
        question = base._replace(payload=payload)
        match mutator.draw.randrange(4):
            case 0:
                question = question._replace(key=mutator.text(base.key))
            case 1:
                question = question._replace(encoding=mutator.draw.choice(asked).encoding)
            case 2:
                question = question._replace(payload=mutator.splice(base.payload, mutator.draw.choice(asked).payload))
            case _:
                pass
        for node in nodes:
            reply, publications = node.on_command(question, 0)
            _is_one_line(reply.text)
            assert not any(isinstance(item.message, messages.Alarm) for item in publications if not reply.accepted)
            told["accepted" if reply.accepted else "refused"] += 1
    return {"commands": count, **told}


def _is_one_line(text: str) -> None:
    assert text, "nothing is said"
    assert "\n" not in text, text


def _ignore(_: str) -> None:
    """Say nothing."""


def fuzz_states(count: int, seed: int = 3) -> dict[str, int]:
    """Strange bytes for a stored state: refused in one line, and nothing has changed."""
    mutator, monitor, refused = Mutator(seed), Monitor(MONITOR, 0), 0
    for item in samples_of(simulate_record(PlantConfig(seed=seed), 300), MONITOR.plant, 0):
        monitor.on_message(encode(item), 0)
    stored, other = monitor.to_bytes(), Monitor(MONITOR, 0)
    before = other.to_bytes()
    for _ in range(count):
        strange = mutator.flip_bits(stored) if mutator.draw.random() < 0.5 else mutator.splice(stored, stored)
        if strange == stored:
            continue
        try:
            other.from_bytes(strange)
        except InputError as error:
            _is_one_line(str(error))
            refused += 1
    assert other.to_bytes() == before
    return {"states": count, "refused": refused}


def fuzz_settings(count: int, seed: int = 4) -> dict[str, int]:
    """Strange settings files: each is an error in one line, or valid for every node."""
    mutator, told = Mutator(seed), Counter[str]()
    whole = settings_text({name: kind() for name, kind in TABLES.items()})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "settings.toml"
        for _ in range(count):
            path.write_text(mutator.settings(whole), encoding="utf-8", errors="surrogatepass")
            try:
                tables = read_settings(path)
                configs = {name: section(kind, name, tables, {}) for name, kind in TABLES.items()}
                Monitor(configs["monitor"], 0)
                if mutator.draw.random() < PLANTS:
                    plant_from(configs["plant"])
            except InputError as error:
                _is_one_line(str(error))
                told["errors"] += 1
            else:
                told["valid"] += 1
    return {"settings": count, **told}


def studies(count: int) -> Iterator[tuple[str, Callable[[], dict[str, int]]]]:
    """Yield the studies by name, with a number of messages and all else in proportion."""
    share = count / COUNT
    yield "messages", lambda: fuzz_messages(count)
    yield "commands", lambda: fuzz_commands(round(COMMANDS * share))
    yield "stored states", lambda: fuzz_states(round(STATES * share))
    yield "settings", lambda: fuzz_settings(round(SETTINGS * share))


if __name__ == "__main__":
    np.seterr(all="raise", under="ignore")
    for name, study in studies(int(sys.argv[1]) if len(sys.argv) > 1 else COUNT):
        began = time.process_time()
        found = study()
        print(f"{name}: {', '.join(f'{count:,} {what}' for what, count in found.items())}", end="")
        print(f"; {time.process_time() - began:.0f} s")

"""Failures around a monitor cost no alarm of the plant, raise none of their own, and are counted."""

import itertools
import random
import signal
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.fuzz import Mutator
from benchmarks.harness.site import connect_client
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, decode, encode, encoding_of
from reactorwatch.contract.messages_pb2 import QUALITY_GOOD, Sample
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.runtime.config import BusConfig

from .live_run import PLANT, SILENCE, WITHIN_S, LiveRun, is_of_plant

DURATION_MIN, SPEED = 40.0, 240.0
LARGE, GARBAGE = 30, 20_000
SECOND_NS = 1_000_000_000


@pytest.fixture
def run(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[LiveRun]:
    with LiveRun(tmp_path, DURATION_MIN, getattr(request, "param", SPEED), isolation=False) as going:
        yield going


@pytest.mark.slow
def test_a_monitor_that_was_frozen_receives_later_what_it_missed(run: LiveRun) -> None:
    """Stopped for longer than its patience with the plant, while it watches."""
    monitor, plant = run.start_all()
    run.wait_until(18.0)
    monitor.send_signal(signal.SIGSTOP)
    run.wait_until(36.0)
    monitor.send_signal(signal.SIGCONT)
    run.end(plant)
    assert run.health.stalls > 0
    assert run.health.lost == 0
    assert run.recorded_alarms() == run.expected_alarms()


def test_a_plant_that_is_frozen_is_silent_until_it_resumes(run: LiveRun) -> None:
    _, plant = run.start_all()
    run.wait_until(20.0)
    plant.send_signal(signal.SIGSTOP)
    run.wait(lambda: [alarm.event for alarm in run.alarms if alarm.alarm == SILENCE][-1:] == ["raised"])
    plant.send_signal(signal.SIGCONT)
    run.wait(lambda: [alarm.event for alarm in run.alarms if alarm.alarm == SILENCE][-1:] == ["cleared"])
    run.end(plant)
    assert run.health.lost == 0
    assert run.recorded_alarms() == run.expected_alarms()


@pytest.mark.slow
def test_a_router_that_is_killed_and_started_again_costs_no_alarm(run: LiveRun) -> None:
    _, plant = run.start_all()
    for minute in (8.0, 20.0):
        run.wait_until(minute)
        run.router.kill()
        run.router.restart()
    run.end(plant)
    assert run.health.lost == 0
    assert run.recorded_alarms() == run.expected_alarms()


def flood(config: BusConfig) -> None:
    """One publisher sends payloads of ten megabytes, and garbage as fast as it can, on the keys of the samples."""
    bus = connect_client(BusConfig(endpoint=config.endpoint, cache_messages=LARGE))
    mutator, encoding = Mutator(5), encoding_of(Sample)
    heard = [
        encode(
            Publication(keys.key(PLANT, keys.SAMPLE, signal), Sample(time_ns=10**18, value=1.0, quality=QUALITY_GOOD))
        )
        for signal in ("qc", "C", "T")
    ]
    for number in range(GARBAGE):
        key = mutator.draw.choice(
            [message.key for message in heard] + [keys.key(PLANT, keys.SAMPLE, f"x{number % 200}")]
        )
        bus.publish(mutator.message(heard)._replace(key=key))
        if number % (GARBAGE // LARGE) == 0:
            bus.publish(
                Encoded(keys.key(PLANT, keys.SAMPLE, "T"), random.Random(number).randbytes(10_000_000), encoding)
            )
    bus.close()


FLOOD = """
import sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["{sys.argv[1]}"]')
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    publisher = session.declare_publisher(sys.argv[2], congestion_control=zenoh.CongestionControl.DROP)
    start = time.monotonic()
    for second in range(int(sys.argv[3])):
        for _ in range(200_000):
            publisher.put(bytes(30))
        time.sleep(max(0.0, start + second + 1 - time.monotonic()))
"""
"""A program that sends 200,000 short messages of garbage a second, for some seconds."""


@pytest.mark.slow
@pytest.mark.parametrize("run", [60.0], indirect=True)
@pytest.mark.parametrize("signal", ["T", "unknown"])
def test_a_sound_plant_is_not_silent_during_a_flood(run: LiveRun, signal: str) -> None:
    """The flood takes more time than the plant has before it is taken to be silent."""
    _, plant = run.start_all()
    run.wait_until(10.0)
    refused = run.health.refused
    key = keys.key(PLANT, keys.SAMPLE, signal)
    subprocess.run([sys.executable, "-c", FLOOD, run.config.endpoint, key, "15"], check=True, timeout=WITHIN_S)
    run.wait(lambda: run.health.refused > refused)
    run.end(plant)
    assert SILENCE not in {alarm.alarm for alarm in run.alarms}


def memory_mb(process: "subprocess.Popen[bytes]") -> float:
    """The most that it ever took."""
    (line,) = [
        line for line in Path(f"/proc/{process.pid}/status").read_text().splitlines() if line.startswith("VmHWM")
    ]
    return int(line.split()[1]) / 1024


@pytest.mark.slow
def test_a_flood_of_garbage_and_of_large_payloads_is_refused_and_takes_no_memory(run: LiveRun) -> None:
    monitor, plant = run.start_all()
    run.wait_until(17.0)
    before_mb = memory_mb(monitor)
    flood(run.config)
    run.wait(lambda: run.health.refused_by_reason["too_large"] >= LARGE)
    assert memory_mb(monitor) < before_mb + 300.0
    run.end(plant)
    assert run.health.refused_by_reason["payload"] > 0
    assert run.recorded_alarms() == run.expected_alarms()


@pytest.mark.slow
def test_a_second_plant_of_the_same_name_is_refused(run: LiveRun) -> None:
    """It has a clock of its own, and publishes for half of the run, its samples between those of the first plant.

    Two free processes would not do: the second counts as a restart of the first while a busy machine holds that up for
    eight samples (`sequence_check`). So a sample of the second goes out only when the router has passed on its last one
    and one of the first of that signal after it, as a further client sees.
    """
    second, listener = connect_client(run.config), connect_client(run.config)
    numbers, first_ns, on_the_way = defaultdict[str, Iterator[int]](itertools.count), list[int](), set[str]()

    def publish_as_second(message: Encoded) -> None:
        sample = decode(message.payload, message.encoding)
        assert isinstance(sample, Sample)
        if not is_of_plant(sample):
            on_the_way.discard(message.key)
            return
        first_ns.append(sample.time_ns)
        if 10.0 < (sample.time_ns - first_ns[0]) / MINUTE_NS < 30.0 and message.key not in on_the_way:
            sample.sequence = next(numbers[message.key])
            sample.time_ns = sample.sequence * 6 * SECOND_NS
            sample.value *= 1.01
            on_the_way.add(message.key)
            second.publish(encode(Publication(message.key, sample)))

    run.start("recorder")
    run.start("monitor")
    listener.subscribe(keys.all_keys(PLANT, keys.SAMPLE), publish_as_second)
    run.end(run.start("plant"))
    listener.close()
    second.close()
    assert run.health.refused_by_reason["out_of_place"] > 300
    assert run.recorded_alarms() == run.expected_alarms()

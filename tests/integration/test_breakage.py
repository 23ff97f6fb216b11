"""What breaks around a monitor costs no alarm of the plant's, raises none of its own, and is counted."""

import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from benchmarks.fuzz import Mutator
from benchmarks.link_cuts import connected
from reactorwatch.cli.processes import write_settings
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode, encoding_of
from reactorwatch.contract.messages_pb2 import QUALITY_GOOD, Sample
from reactorwatch.runtime.config import BusConfig

from .live_run import PLANT, SILENCE, WITHIN_S, LiveRun

DURATION_MIN, SPEED = 40.0, 240.0
UNHURRIED = 60.0
"""Eight samples of another are a restarted plant if the first is held up meanwhile: at this speed for 0.8 s."""
LARGE, GARBAGE = 30, 20_000
SECOND_NS = 1_000_000_000


@pytest.fixture
def run(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[LiveRun]:
    with LiveRun(tmp_path, DURATION_MIN, getattr(request, "param", SPEED)) as going:
        yield going


def test_a_killed_router_a_frozen_plant_and_a_frozen_monitor_cost_no_alarm(run: LiveRun) -> None:
    """Of one run: what it missed, the monitor hears later, and while the plant is frozen it is silent.

    The router is killed in training and while alarms stand; the plant is frozen while it is watched; the monitor is
    frozen for longer than its patience with the plant, while the leak begins.
    """
    monitor, plant = run.start_all()
    run.wait_until(8.0)
    run.router.kill()
    run.router.restart()
    run.wait_until(16.0)
    plant.send_signal(signal.SIGSTOP)
    run.wait(lambda: [alarm.event for alarm in run.alarms if alarm.alarm == SILENCE][-1:] == ["raised"])
    plant.send_signal(signal.SIGCONT)
    run.wait(lambda: [alarm.event for alarm in run.alarms if alarm.alarm == SILENCE][-1:] == ["cleared"])
    run.wait_until(18.0)
    monitor.send_signal(signal.SIGSTOP)
    run.wait_until(36.0)
    monitor.send_signal(signal.SIGCONT)
    run.router.kill()
    run.router.restart()
    run.end(plant)
    assert run.health.stalls > 0
    assert run.health.lost == 0
    assert run.recorded_alarms() == run.expected_alarms()


def flood(config: BusConfig) -> None:
    """One publisher sends payloads of ten megabytes, and garbage as fast as it can, on the keys of the samples."""
    bus = connected(BusConfig(endpoint=config.endpoint, cache_messages=LARGE))
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


def memory_mb(process: "subprocess.Popen[bytes]") -> float:
    """The most that it ever took."""
    (line,) = [
        line for line in Path(f"/proc/{process.pid}/status").read_text().splitlines() if line.startswith("VmHWM")
    ]
    return int(line.split()[1]) / 1024


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


@pytest.mark.parametrize("run", [UNHURRIED], indirect=True)
def test_a_second_plant_of_the_same_name_is_refused(run: LiveRun, tmp_path: Path) -> None:
    """It has a clock of its own, and lives for the middle half of the run."""
    other = msgspec.structs.replace(run.plant, seed=99, zero_ns=0, duration_min=0.5 * DURATION_MIN, wait_for=("leave",))
    settings = tmp_path / "other.toml"
    write_settings(settings, {"bus": run.config, "plant": other})
    run.start("recorder")
    run.start("monitor")
    # It is started before, as a busy machine takes longer for that than the run lasts.
    second = subprocess.Popen([sys.executable, "-m", "plant_node", str(settings)], stderr=subprocess.PIPE, text=True)
    try:
        assert second.stderr is not None
        assert any("leave" in line for line in second.stderr), "it does not wait"
        plant = run.nodes.start("plant")
        run.wait_until(10.0)
        run.bus.announce(keys.key(PLANT, keys.ALIVE, "leave"))
        second.communicate(timeout=WITHIN_S)
        assert second.returncode == 0
    finally:
        second.kill()
        second.communicate()
    run.end(plant)
    assert run.health.refused_by_reason["out_of_place"] > 300
    assert run.recorded_alarms() == run.expected_alarms()

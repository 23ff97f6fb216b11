"""`reactorwatch alarm` against a monitor process on a real router, which is killed and restarted."""

import json
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.message import Message

from reactorwatch.contract.codec import Encoded, decode
from reactorwatch.contract.messages_pb2 import Alarm, AlarmKpis, AlarmState, Estimate
from reactorwatch.records.record import to_time_ns
from reactorwatch.runtime.bus_zenoh import ZenohBus, router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import free_endpoint
from tests.running import Command
from tests.unit.monitor_node.samples import leaking_run, samples

WITHIN_S = 60.0
END_MIN = 140.0


class Control:
    """The router, what is heard on it, and the processes beside it.

    Args:
        bus: the router.
        endpoint: where it listens.
        folder: for settings and the file of alarm states.
        called: runs a command.
    """

    def __init__(self, bus: ZenohBus, endpoint: str, folder: Path, called: Command) -> None:
        self.bus = bus
        self._called = called
        self.file = folder / "monitor.state"
        self.received: list[Message] = []
        self.alive = False
        self._changed = threading.Condition()
        self._settings = folder / "settings.toml"
        self._settings.write_text(
            f'[bus]\nendpoint = "{endpoint}"\n[monitor]\nstate_file = "{self.file}"\n', encoding="utf-8"
        )
        bus.subscribe_liveliness("reactor/cstr/alive/monitor", self._on_alive)
        bus.subscribe("reactor/**", self._on_message)

    def monitor(self) -> subprocess.Popen[str]:
        """Start a monitor, and wait until it listens or ends."""
        process = subprocess.Popen(
            [sys.executable, "-m", "monitor_node", str(self._settings)], stderr=subprocess.PIPE, text=True
        )
        with self._changed:
            assert self._changed.wait_for(lambda: self.alive, WITHIN_S), "no monitor"
        return process

    def kill(self, process: subprocess.Popen[str]) -> None:
        """End a monitor without a last word."""
        process.kill()
        process.communicate()
        with self._changed:
            assert self._changed.wait_for(lambda: not self.alive, WITHIN_S), "its token is still there"

    def wait_for(self, condition: Callable[[Message], bool]) -> Message:
        """The first message heard that is so."""
        found: list[Message] = []

        def is_there() -> bool:
            found[:] = [message for message in self.received if condition(message)]
            return bool(found)

        with self._changed:
            assert self._changed.wait_for(is_there, WITHIN_S)
        return found[0]

    def alarm(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """`reactorwatch alarm` to its end."""
        return self._called("alarm", *arguments, "--config", str(self._settings))

    def listed(self) -> dict[str, dict[str, Any]]:
        """What `alarm list --json` says, by alarm."""
        done = self.alarm("list", "--json")
        assert done.returncode == 0, done.stderr
        return {item["alarm"]: item for item in map(json.loads, done.stdout.splitlines())}

    def _on_message(self, message: Encoded) -> None:
        with self._changed:
            self.received.append(decode(message.payload, message.encoding))
            self._changed.notify_all()

    def _on_alive(self, _: str, is_alive: bool) -> None:
        with self._changed:
            self.alive = is_alive
            self._changed.notify_all()


@pytest.fixture
def control(tmp_path: Path, called: Command) -> Iterator[Control]:
    endpoint = free_endpoint()
    bus = router(BusConfig(endpoint=endpoint))
    yield Control(bus, endpoint, tmp_path, called)
    bus.close()


def test_the_operator_s_word_is_done_published_and_survives_a_kill(control: Control) -> None:
    process = control.monitor()
    try:
        for message in samples(*leaking_run(-0.1, 130.0, END_MIN, seed=1)):
            control.bus.publish(message)
        control.wait_for(lambda item: isinstance(item, Estimate) and item.time_ns == to_time_ns(END_MIN))
        assert control.listed()["shewhart/T"]["state"] == "unacknowledged"

        done = control.alarm("acknowledge", "shewhart/T", "--by", "Anna", "--comment", "seen")
        assert done.returncode == 0, done.stderr
        expected = r"shewhart/T \(high\): acknowledged; raised 1970-01-01 02:10:\d\d UTC \(incident 1.*\); T is "
        assert re.match(expected, done.stdout)
        assert done.stdout.endswith("; Anna: seen\n")
        changed = control.wait_for(lambda item: isinstance(item, Alarm) and item.event == "acknowledge")
        assert isinstance(changed, Alarm)
        assert (changed.state, changed.by) == (AlarmState.ALARM_STATE_ACKNOWLEDGED, "Anna")
        assert changed.time_ns == to_time_ns(END_MIN)

        again = control.alarm("acknowledge", "shewhart/T", "--by", "Ben")
        assert again.returncode == 2
        assert again.stderr == "reactorwatch: alarm shewhart/T is acknowledged already\n"
        rest = control.alarm("ack", "--all", "--by", "Cem", "--json")
        assert rest.returncode == 0, rest.stderr
        others = {item["alarm"]: item for item in map(json.loads, rest.stdout.splitlines())}
        assert {"ewma/T", "mewma/all"} <= others.keys()
        assert {(item["state"], item["by"]) for item in others.values()} == {("acknowledged", "Cem")}
        header, *rows = control.alarm("list").stdout.splitlines()
        assert header.split()[:3] == ["priority", "incident", "alarm"]
        assert {row.split()[2] for row in rows} == {"shewhart/T", *others}
        assert [row.split()[0] for row in rows] == sorted(
            (row.split()[0] for row in rows), key=["high", "medium"].index
        )
        assert all("10 % of the coolant lost (" in row for row in rows)
        none = control.alarm("ack", "--all", "--by", "Cem")
        assert (none.returncode, none.stderr) == (2, "reactorwatch: there is no alarm to acknowledge\n")
        both = control.alarm("acknowledge", "ewma/T", "--incident", "1", "--by", "Cem")
        assert (both.returncode, both.stderr.count("name one of")) == (2, 1)
        assert control.alarm("shelve", "shewhart/C", "--by", "Ben", "--minutes", "30").returncode == 0
        control.wait_for(lambda item: isinstance(item, AlarmKpis) and item.shelved == 1)
    finally:
        control.kill(process)

    process = control.monitor()
    try:
        listed = control.listed()
        assert (listed["shewhart/T"]["state"], listed["shewhart/T"]["by"]) == ("acknowledged", "Anna")
        assert listed["shewhart/C"]["shelved_until_ns"] == to_time_ns(END_MIN + 30)
    finally:
        control.kill(process)


def test_a_damaged_file_ends_the_monitor_with_one_line_and_is_left_alone(control: Control, tmp_path: Path) -> None:
    control.file.write_bytes(b"no state")
    done = subprocess.run(
        [sys.executable, "-m", "monitor_node", str(tmp_path / "settings.toml")],
        capture_output=True, text=True, timeout=WITHIN_S, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    line = done.stderr.splitlines()[-1]  # after those of its connection
    assert line.startswith(f"monitor: state_file {control.file}: is no state of a monitor: ")
    assert control.file.read_bytes() == b"no state"


def test_without_a_monitor_or_a_name_there_is_one_line(control: Control) -> None:
    done = control.alarm("list")
    assert done.returncode == 2
    assert done.stderr == "reactorwatch: no monitor of plant 'cstr' answered within 5 s; is it running?\n"
    done = control.alarm("acknowledge", "shewhart/T")
    assert done.returncode == 2
    assert "--by" in done.stderr

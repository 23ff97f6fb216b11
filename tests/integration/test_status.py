"""`reactorwatch status` over a router, with and without certificates."""

import json
import subprocess
import time
from collections.abc import Callable

from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, CommandReply, Health
from reactorwatch.runtime.bus_zenoh import connect_now, router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import free_endpoint

from ..end_to_end.conftest import REACTORWATCH
from .site import WITHIN_S, Site


def status(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([REACTORWATCH, "status", *arguments], capture_output=True, text=True, check=False)


def status_once(is_whole: Callable[[str], bool], *arguments: str) -> str:
    """What it prints after half a second: called again while a busy machine has not brought all by then."""
    latest = time.monotonic() + WITHIN_S
    while True:
        done = status(*arguments, "--seconds", "0.5")
        assert done.returncode == 0, done.stderr
        if is_whole(done.stdout) or time.monotonic() > latest:
            return done.stdout


def test_a_viewer_sees_the_nodes_and_the_alarms_of_its_plant(site: Site) -> None:
    monitor, other = site.join("cstr/monitor"), site.join("other/plant")
    other.declare_token("reactor/other/alive/plant")
    monitor.declare_token("reactor/cstr/alive/monitor")
    standing = Alarm(time_ns=1, alarm="ewma/T", state=AlarmState.ALARM_STATE_UNACKNOWLEDGED)
    monitor.declare_queryable(
        "reactor/cstr/command/list_alarms",
        lambda request: request.reply(CommandReply(accepted=True, alarms=[standing])),
    )
    health = Health(time_ns=1, node="monitor", phase="watching")
    monitor.publish(encode(Publication("reactor/cstr/health/monitor", health)))
    settings = str(site.folder / "cstr" / "viewer" / "settings.toml")
    said = status_once(
        lambda text: all(word in text for word in ("watching", "true", "ewma/T")), "--config", settings, "--json"
    )
    (plant,) = json.loads(said)["plants"]
    assert plant["plant"] == "cstr"
    assert [(node["node"], node["alive"], node["phase"]) for node in plant["nodes"]] == [("monitor", True, "watching")]
    assert [alarm["alarm"] for alarm in plant["alarms"]] == ["ewma/T"]


def test_without_certificates_all_plants_are_shown() -> None:
    config = BusConfig(endpoint=free_endpoint())
    bus = router(config)
    speaker = connect_now(config)
    try:
        for plant in ("a", "b"):
            speaker.declare_token(f"reactor/{plant}/alive/plant")
        assert not speaker.query(Encoded("reactor/a/command/list_alarms", b"", ""), 5.0)  # the tokens are known by now
        said = status_once(
            lambda text: len(json.loads(text)["plants"]) == 2, "--endpoint", config.endpoint, "--once", "--json"
        )
    finally:
        speaker.close()
        bus.close()
    rows = [[item["plant"], *(node["node"] for node in item["nodes"])] for item in json.loads(said)["plants"]]
    assert rows == [["a", "plant"], ["b", "plant"]]


def test_a_missing_router_is_reported_in_one_line() -> None:
    done = status("--endpoint", free_endpoint())
    assert done.returncode == 2
    assert "no router at" in done.stderr
    assert done.stderr.count("\n") == 1

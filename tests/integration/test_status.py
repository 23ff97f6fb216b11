"""`reactorwatch status` over a router, with and without certificates."""

import json
import subprocess

from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, CommandReply, Health
from reactorwatch.runtime.bus_zenoh import connect_now, router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.loopback import free_endpoint

from ..end_to_end.conftest import REACTORWATCH
from .site import Site


def status(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([REACTORWATCH, "status", *arguments], capture_output=True, text=True, check=False)


def test_a_viewer_sees_the_nodes_and_the_alarms_of_its_plant(site: Site) -> None:
    monitor, other = site.join("cstr/monitor"), site.join("other/plant")
    other.announce("reactor/other/alive/plant")
    monitor.announce("reactor/cstr/alive/monitor")
    standing = Alarm(time_ns=1, alarm="ewma/T", state=AlarmState.ALARM_STATE_UNACKNOWLEDGED)
    monitor.answer(
        "reactor/cstr/command/list_alarms",
        lambda request: request.reply(CommandReply(accepted=True, alarms=[standing])),
    )
    health = Health(time_ns=1, node="monitor", phase="watching")
    monitor.publish(encode(Publication("reactor/cstr/health/monitor", health)))
    settings = str(site.folder / "cstr" / "viewer" / "settings.toml")
    done = status("--config", settings, "--json", "--seconds", "0.5")
    assert done.returncode == 0, done.stderr
    (plant,) = json.loads(done.stdout)["plants"]
    assert plant["plant"] == "cstr"
    assert [(node["node"], node["alive"], node["phase"]) for node in plant["nodes"]] == [("monitor", True, "watching")]
    assert [alarm["alarm"] for alarm in plant["alarms"]] == ["ewma/T"]


def test_without_certificates_all_plants_are_shown() -> None:
    config = BusConfig(endpoint=free_endpoint())
    bus = router(config)
    speaker = connect_now(config)
    try:
        for plant in ("a", "b"):
            speaker.announce(f"reactor/{plant}/alive/plant")
        assert not speaker.ask(Encoded("reactor/a/command/list_alarms", b"", ""), 5.0)  # the tokens are known by now
        done = status("--endpoint", config.endpoint, "--once", "--seconds", "0.5")
    finally:
        speaker.close()
        bus.close()
    assert done.returncode == 0, done.stderr
    rows = [line.split()[1:5:2] for line in done.stdout.splitlines() if line.startswith("│")]
    assert rows == [["a", "plant"], ["b", "plant"]]


def test_without_a_router_it_says_so_in_one_line() -> None:
    done = status("--endpoint", free_endpoint())
    assert done.returncode == 2
    assert "no router at" in done.stderr
    assert done.stderr.count("\n") == 1

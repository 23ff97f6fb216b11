"""Memory of a publisher, for subscribers that missed messages, is bounded for every kind of them."""

import pytest

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.bus_zenoh import connect_now
from reactorwatch.runtime.bus_zenoh.bus import MAX_INCIDENTS
from reactorwatch.runtime.bus_zenoh.messages import EVERY_ROW, MAX_CACHED_OF_OTHERS
from reactorwatch.runtime.config import BusConfig

PUBLISHED = 1000
KINDS = (
    keys.SAMPLE, keys.ESTIMATE, keys.CHART, keys.RECONSTRUCTION,
    keys.MODEL, keys.ALARM, keys.INCIDENT, keys.ALARM_KPIS, keys.HEALTH, keys.FAULT, keys.AUDIT,
)  # fmt: skip


@pytest.fixture(scope="module")
def remembered(request: pytest.FixtureRequest) -> dict[str, int]:
    """Messages that a publisher remembers of each kind, after it has published a thousand on a key of each."""
    from reactorwatch.runtime import bus_zenoh
    from reactorwatch.runtime.http_pages import free_endpoint

    config = BusConfig(endpoint=free_endpoint())
    buses = [bus_zenoh.router(config), connect_now(config), connect_now(config)]
    try:
        for number in range(PUBLISHED):
            for kind in KINDS:
                buses[1].publish(Encoded(keys.key("cstr", kind, "T"), b"%d" % number, "text/plain"))
        return {kind: len(buses[2].query_history(keys.all_keys("cstr", kind))) for kind in KINDS}
    finally:
        for bus in reversed(buses):
            bus.close()


@pytest.mark.parametrize("kind", KINDS)
def test_messages_that_do_not_come_with_every_row_are_kept_for_a_while_only(
    kind: str, remembered: dict[str, int]
) -> None:
    """Else figures of alarms and models would take more memory each minute of a day at the plant's own pace."""
    assert remembered[kind] == (PUBLISHED if kind in EVERY_ROW else MAX_CACHED_OF_OTHERS)


def test_the_incidents_of_years_are_not_kept_but_the_newest_are() -> None:
    from reactorwatch.runtime import bus_zenoh
    from reactorwatch.runtime.http_pages import free_endpoint

    config, published = BusConfig(endpoint=free_endpoint()), 2 * MAX_INCIDENTS
    buses = [bus_zenoh.router(config), connect_now(config), connect_now(config)]
    try:
        for number in range(1, published + 1):
            for plant in ("cstr", "other"):
                buses[1].publish(Encoded(keys.key(plant, keys.INCIDENT, str(number)), b"%d" % number, "text/plain"))
        kept = [int(item.payload) for item in buses[2].query_history(keys.all_keys("cstr", keys.INCIDENT))]
    finally:
        for bus in reversed(buses):
            bus.close()
    assert sorted(kept) == list(range(published - MAX_INCIDENTS + 1, published + 1))

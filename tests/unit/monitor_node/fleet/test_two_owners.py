"""Two monitors take over from each other, and one is stalled anywhere: each alarm is published once, and none lost."""

from collections import Counter

import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from monitor_node.core import Monitor
from reactorwatch.contract.codec import Encoded

from ..fleets import QUICK, SECOND_NS
from .two_owners import FIRST_ROW, PLANT, ROWS, Published, World, alone_from, leaking


class Case:
    """A plant, its state before the leak, and what a monitor says that has it alone."""

    def __init__(self, state: bytes, rows: list[Encoded]) -> None:
        self.state, self.rows = state, rows
        self.expected = Counter(alone_from(state, rows[3 * FIRST_ROW :]))

    def run(self, script: list[str]) -> Counter[Published]:
        return Counter(World(self.state, self.rows, script).run())


@pytest.fixture(scope="module")
def case() -> Case:
    rows = leaking()[: 3 * (FIRST_ROW + ROWS)]
    monitor = Monitor(msgspec.structs.replace(QUICK, plant=PLANT), 0, points=False)
    for place, message in enumerate(rows[: 3 * FIRST_ROW]):
        monitor.on_message(message, place // 3 * SECOND_NS)
    return Case(monitor.to_bytes(), rows)


TIMEOUT = "silence/plant"
ALONE = ("handle", "store", "kill", "pause", "resume")
RECOVERY = ("handle", "recover", "recover", "handle")

STEPS = st.one_of(
    st.integers(1, 5).map(lambda rows: ["row"] * rows),
    st.integers(1, 12).map(lambda steps: [f"stall {steps}"]),  # of the monitor that comes to its next alarm
    st.builds(lambda step, name: [f"{step} {name}"], st.sampled_from(ALONE), st.sampled_from(["first", "second"])),
    st.just(["token"]),
    st.sampled_from(["first", "second"]).map(lambda name: ["token", f"handle {name}"]),
    st.sampled_from(["first", "second"]).map(lambda name: [f"{step} {name}" for step in RECOVERY]),
)
SCRIPTS = st.lists(STEPS, max_size=30).map(lambda parts: [step for part in parts for step in part])


LEAK = ["row"] * 5
"""Rows up to the first alarm."""

TAKE_OVER = ["token", *[f"{step} second" for step in RECOVERY]]
COME_BACK = ["kill first", *[f"{step} first" for step in RECOVERY], "token"]


STALLED_BEFORE_PUBLISHING = [*LEAK, "stall 5", "handle first", *TAKE_OVER]
STALLED_WITH_A_BACKLOG = [*LEAK, *TAKE_OVER, "handle first"]
BOTH_STALLED = ["stall 8", *LEAK, *TAKE_OVER, *COME_BACK, "handle second"]
OLDER_STATE_STORED = ["token", *LEAK, *TAKE_OVER[1:], "store first"]
RESTARTED = [*LEAK, *TAKE_OVER, *COME_BACK, "handle second"]


@given(script=SCRIPTS)
@example(script=STALLED_BEFORE_PUBLISHING)
@example(script=STALLED_WITH_A_BACKLOG)
@example(script=BOTH_STALLED)
@example(script=OLDER_STATE_STORED)
@example(script=RESTARTED)
@settings(max_examples=15, deadline=None)
def test_with_any_stall_and_any_order_of_what_is_noticed_each_alarm_is_published_once(
    script: list[str], case: Case
) -> None:
    assert case.run(script) == case.expected


SILENT_SCRIPTS = st.lists(
    st.one_of(
        STEPS,
        st.integers(1, 8).map(lambda seconds: ["second"] * seconds),
        st.sampled_from(["first", "second"]).map(lambda name: [f"handle {name}", *["second", f"tick {name}"] * 7]),
    ),
    max_size=30,
).map(lambda parts: [step for part in parts for step in part])


@given(script=SILENT_SCRIPTS)
@example(script=["row", "handle first", *["second", "tick first"] * 7, *TAKE_OVER, *["second", "tick second"] * 7])
@example(script=["row", "handle first", "stall 5", *["second", "tick first"] * 5, "tick first", *TAKE_OVER])
@settings(max_examples=10, deadline=None)
def test_a_data_timeout_by_the_clock_is_raised_once_and_cleared_once_by_either_owner(
    script: list[str], case: Case
) -> None:
    """No row shows it: the plant pauses, and either monitor may notice."""
    published = case.run(script)
    timeouts = Counter((event, raised_ns) for alarm, event, _, raised_ns in published.elements() if alarm == TIMEOUT)
    raised, cleared = ({ns for event, ns in timeouts if event == change} for change in ("raised", "cleared"))
    assert (set(timeouts.values()), raised) == ({1}, cleared)
    assert {change for change in published if change[0] != TIMEOUT} == {
        change for change in case.expected if change[0] != TIMEOUT
    }


def test_alarms_of_a_killed_monitor_that_arrived_before_its_plant_s_history_are_not_published_again(case: Case) -> None:
    """The first publishes after the second has noticed that it is gone, and is killed before it stores anything."""
    publishes = [*LEAK, "token", "handle second", "handle first", "crash first"]
    assert case.run([*publishes, "recover second", "recover second", "handle second"]) == case.expected

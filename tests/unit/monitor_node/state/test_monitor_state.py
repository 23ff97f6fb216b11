"""A monitor that resumes from its stored state publishes what it would have published, value for value.

A stored state names the build that stored it.
"""

import random
from itertools import chain
from typing import Any, Literal

import msgspec
import pytest

from monitor_node.config import ChartName, MonitorConfig
from monitor_node.core import Monitor
from monitor_node.monitor_state import (
    MAGIC,
    VERSION,
    ForeignFileError,
    MonitorState,
    OtherSettingsError,
    learning_settings,
    open_seal,
    open_state,
    seal,
)
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, encode, encode_message
from reactorwatch.contract.messages_pb2 import AlarmCommand, Health, ShelveAlarm
from reactorwatch.errors import InputError
from reactorwatch.process.library.cstr import cstr
from reactorwatch.version import this_build

from ..samples import PLANT, leaking_run, samples

ALL_CHARTS: tuple[ChartName, ...] = (
    "shewhart", "ewma", "cusum", "t2", "mewma", "pca_t2", "pca_spe", "parameters",
)  # fmt: skip
CONFIG = MonitorConfig(training_min=60.0, charts=ALL_CHARTS)
ONSET_MIN, END_MIN = 70.0, 90.0
SIGNALS = 3


@pytest.fixture(scope="module")
def leak() -> list[Encoded]:
    """The coolant leaks a tenth from minute 70 on, a sensor sticks, another has a spike, and samples are missing."""
    time_min, columns = leaking_run(-0.1, ONSET_MIN, END_MIN, seed=3)
    columns["T"][650] += 30.0
    columns["C"][850:870] = columns["C"][850]
    lost = random.Random(5)
    return [message for message in samples(time_min, columns) if lost.random() > 0.01]


def question(name: str, command: AlarmCommand | ShelveAlarm) -> Encoded:
    payload, encoding = encode_message(command)
    return Encoded(keys.key(PLANT, keys.COMMAND, name), payload, encoding)


ACTS = {
    2500: question("acknowledge", AlarmCommand(alarm="shewhart/T", by="Ada", comment="seen")),
    2510: question("shelve", ShelveAlarm(alarm="ewma/T", by="Ada", minutes=7.0)),
}
"""What an operator does, by the number of the sample before it."""


def run(monitor: Monitor, messages: list[Encoded], first: int, end: int) -> list[list[Encoded]]:
    """What a monitor says because of each message, and of what the operator does then."""
    said = []
    for number in range(first, end):
        told = list(monitor.on_message(messages[number], 0))
        if number in ACTS:
            reply, publications = monitor.on_command(ACTS[number], 0)
            assert reply.accepted, reply.text
            told += publications
        said.append([encode(item) for item in told])
    return said


def stopped_at(
    places: list[int], messages: list[Encoded], config: MonitorConfig, **settings: Any
) -> list[list[Encoded]]:
    """The same of a monitor that was stopped at each of the places and begun again from what it had stored."""
    monitor, said, before = Monitor(config, 0, **settings), list[list[Encoded]](), 0
    for place in [*places, len(messages)]:
        said += run(monitor, messages, before, place)
        stored, monitor, before = monitor.to_bytes(), Monitor(config, 0, **settings), place
        monitor.from_bytes(stored)
    return said


@pytest.mark.parametrize("points", [True, False], ids=["with points", "without"])
@pytest.mark.parametrize(
    ("reference", "resample"), [("process", None), ("process", "9 s,C=last"), ("black-box", None), ("arx", None)]
)
def test_a_monitor_stopped_at_any_samples_publishes_the_same(
    reference: Literal["process", "black-box", "arx"], resample: str | None, points: bool, leak: list[Encoded]
) -> None:
    """In training and watching, in an alarm, acknowledged and shelved, in the middle of a row."""
    config = msgspec.structs.replace(CONFIG, reference=reference, resample=resample)
    whole = run(Monitor(config, 0, points=points), leak, 0, len(leak))
    places = [*sorted(random.Random(reference).sample(range(len(leak)), 12)), 2505, 2520, 2550]
    again = stopped_at(sorted(places), leak, config, points=points)
    differing = [number for number, (first, second) in enumerate(zip(whole, again, strict=True)) if first != second]
    assert differing == []
    events = {item.payload for told in whole for item in told if "/alarm/" in item.key}
    assert len(events) > 3


@pytest.mark.parametrize("version", [*range(2, VERSION), VERSION + 1])
def test_a_state_of_another_layout_is_refused_in_one_line(version: int) -> None:
    stored = seal(open_seal(Monitor(CONFIG, 0).to_bytes()), version)
    text = f"is the state of a monitor in version {version}, this software reads {VERSION}"
    with pytest.raises(InputError, match=f"^{text}$"):
        Monitor(CONFIG, 0).from_bytes(stored)


def test_a_monitor_that_received_nothing_yet_is_stored_and_restored() -> None:
    again = Monitor(CONFIG, 0)
    again.from_bytes(Monitor(CONFIG, 0).to_bytes())
    assert again.phase == "waiting"


def test_a_state_of_the_default_settings_takes_less_than_64_kilobytes(leak: list[Encoded]) -> None:
    """Most of it are the rows of the training, and later those that a cause is looked for in."""
    monitor, sizes = Monitor(MonitorConfig(training_min=60.0), 0), []
    for first in range(0, len(leak), 100):
        run(monitor, leak, first, min(first + 100, len(leak)))
        sizes.append(len(monitor.to_bytes()))
    assert max(sizes) < 64_000


def wrong(stored: bytes) -> list[tuple[str, bytes, str]]:
    """What is no state of ours, and what is said of it."""
    damaged = bytearray(stored)
    damaged[len(stored) // 2] ^= 1
    newer = MAGIC + (VERSION + 1).to_bytes(2, "big") + stored[len(MAGIC) + 2 :]
    return [
        ("empty", b"", "is no state of a monitor: 0 bytes"),
        ("foreign", b"\x89PNG and so on", "is no state of a monitor: 14 bytes"),
        ("cut in its head", stored[: len(MAGIC) + 1], "is no state of a monitor"),
        ("cut", stored[:-100], "is a damaged state of a monitor"),
        ("a bit is another", bytes(damaged), "is a damaged state of a monitor"),
        (
            "of another version",
            newer,
            f"is the state of a monitor in version {VERSION + 1}, this software reads {VERSION}",
        ),
    ]


def test_what_is_no_state_is_refused_in_one_line_and_nothing_has_changed(leak: list[Encoded]) -> None:
    monitor = Monitor(CONFIG, 0)
    run(monitor, leak, 0, 2300)
    stored = monitor.to_bytes()
    other = Monitor(CONFIG, 0)
    before = other.to_bytes()
    for _, data, text in wrong(stored):
        with pytest.raises(InputError, match=f"^{text}"):
            other.from_bytes(data)
        assert other.to_bytes() == before


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        ({"training_min": 50.0}, "training_min was 60.0 and is 50.0"),
        ({"outputs": ("T",)}, r"outputs was \['C', 'T'\] and is \['T'\]"),
    ],
)
def test_a_state_of_other_settings_is_refused_and_the_difference_named(setting: dict[str, Any], text: str) -> None:
    stored = Monitor(CONFIG, 0).to_bytes()
    with pytest.raises(OtherSettingsError, match=f"^was learned with other settings: {text}$"):
        Monitor(msgspec.structs.replace(CONFIG, **setting), 0).from_bytes(stored)


def test_a_state_of_another_plant_is_refused() -> None:
    with pytest.raises(ForeignFileError, match=r"^is the state of plant 'cstr', not of 'other'$"):
        Monitor(msgspec.structs.replace(CONFIG, plant="other"), 0).from_bytes(Monitor(CONFIG, 0).to_bytes())


def test_a_state_learned_with_other_equations_is_refused() -> None:
    stored = Monitor(CONFIG, 0).to_bytes()
    other = Monitor(CONFIG, 0, model=cstr().with_values({"K3": 1.01 * cstr().parameter("K3").value}))
    with pytest.raises(OtherSettingsError, match="equations"):
        other.from_bytes(stored)


def test_where_and_how_often_it_is_stored_is_no_other_setting() -> None:
    stored = Monitor(CONFIG, 0).to_bytes()
    Monitor(msgspec.structs.replace(CONFIG, state_file="x", state_every_s=1.0, health_period_s=1.0), 0).from_bytes(
        stored
    )


# --- what comes again ------------------------------------------------------------------------------------------------


def duplicated(monitor: Monitor) -> int:
    (publication,) = monitor.on_tick(1)
    assert isinstance(publication.message, Health)
    return publication.message.duplicated


@pytest.mark.parametrize("rows_again", [5, 100, 800])
def test_samples_that_were_received_before_the_stop_are_counted_and_change_nothing(
    rows_again: int, leak: list[Encoded]
) -> None:
    """The publisher tells its last rows again, many more than the alignment remembers."""
    place = 2520
    whole = run(Monitor(CONFIG, 0), leak, 0, len(leak))
    monitor, again = Monitor(CONFIG, 0), Monitor(CONFIG, 0)
    run(monitor, leak, 0, place)
    again.from_bytes(monitor.to_bytes())
    first = place - SIGNALS * rows_again
    assert [item for number in range(first, place) for item in again.on_message(leak[number], 0)] == []
    assert run(again, leak, place, len(leak)) == whole[place:]
    assert duplicated(again) == SIGNALS * rows_again


@pytest.mark.parametrize("rows", [1, 2])
@pytest.mark.parametrize("told_again", [True, False])
def test_a_stop_while_samples_are_held_back_after_a_pause_loses_none(rows: int, told_again: bool) -> None:
    """The plant paused, and began to count anew; nobody knows yet that it is the plant."""
    before = list(samples(*leaking_run(0.0, 1.0, 10.0, seed=1)))
    time_min, columns = leaking_run(0.0, 1.0, 5.0, seed=2)
    messages = before + list(samples(time_min + 100.0, columns))
    place = len(before) + SIGNALS * rows
    whole = run(Monitor(CONFIG, 0), messages, 0, len(messages))
    monitor, again = Monitor(CONFIG, 0), Monitor(CONFIG, 0)
    run(monitor, messages, 0, place)
    again.from_bytes(monitor.to_bytes())
    said = run(again, messages, place - 30 if told_again else place, len(messages))
    assert list(chain.from_iterable(said)) == list(chain.from_iterable(whole[place:]))
    assert again.rows == len(messages) // SIGNALS


def test_after_the_history_a_plant_that_repeats_itself_is_accepted() -> None:
    """A simulated plant that is started anew with the same clock publishes the same numbers at the same times."""
    messages = list(samples(*leaking_run(0.0, 1.0, 20.0, seed=1)))
    monitor, again = Monitor(CONFIG, 0), Monitor(CONFIG, 0)
    for message in messages:
        monitor.on_message(message, 0)
    again.from_bytes(monitor.to_bytes())
    again.on_history_end()
    for message in messages:
        again.on_message(message, 0)
    assert again.rows == 2 * monitor.rows


def test_a_plant_that_publishes_nothing_after_the_stop_is_silent(leak: list[Encoded]) -> None:
    """It is waited for from the start on, as long as its receipts before the stop ask for."""
    second = 1_000_000_000
    monitor = Monitor(CONFIG, 0)
    for number, message in enumerate(leak[:300]):
        monitor.on_message(message, number * second)
    again = Monitor(CONFIG, 10_000 * second)
    again.from_bytes(monitor.to_bytes())
    due_ns = again.next_tick_ns()
    while due_ns < 10_000 * second + 3 * second:
        again.on_tick(due_ns)
        due_ns = again.next_tick_ns()
    said = [item for tick in range(10_000, 10_020) for item in again.on_tick(tick * second)]
    assert [item.key for item in said if "/alarm/" in item.key] == [keys.key(PLANT, keys.ALARM, "silence/plant")]


def test_a_state_names_the_build_that_stored_it_and_its_refusal_names_another_build() -> None:
    monitor = Monitor(CONFIG, 0, points=False)
    settings = learning_settings(CONFIG, monitor.pipeline.model, points=False)
    data = monitor.to_bytes()
    assert MonitorState.from_bytes(open_seal(data)).build == this_build()
    other = msgspec.structs.replace(open_state(data, settings), build="0.2.0 (commit 0123456789ab)").to_bytes()
    assert open_state(seal(other), settings).settings == settings
    with pytest.raises(OtherSettingsError, match=r"learned by 0\.2\.0 \(commit 0123456789ab\) with other settings"):
        open_state(seal(other), settings | {"training_min": 7.0})
    with pytest.raises(OtherSettingsError, match=r"^was learned with other settings"):
        open_state(data, settings | {"training_min": 7.0})

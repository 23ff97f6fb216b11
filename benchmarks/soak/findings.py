"""Assessment of a soak: samples accounted for, faults alarmed once, memory level.

- **Samples.** A monitor puts each sample of a plant into a row, or counts it as lost (it never came, by its number) or
  late (its row had been judged). The rows have three places each, of which one or two are empty in each incomplete
  row. So samples that were published and are in no place must be no more than what was counted, and samples in places
  no more than what was published; what exceeds that is unaccounted for. Garbage must be among what was refused. (A few
  of it are rightly counted as late: a sample with a number and a time of long ago.)
- **Alarms.** A fault is alarmed once if the first alarm of its plant comes up within `SOON_ROWS` of the onset, none
  does before, and no alarm of the plant is raised while it stands. A plant without a fault has no alarm. Silences of
  the plant do not count in this: where a link is cut there is silence, and it is said; but each once, and it must be
  over in the end.
- **Nothing else.** What was said of alarms, silences apart, is what one monitor says that heard all and was never
  stopped: `backtest` on what the plants have published. Of a plant of which something was counted as lost or late that
  cannot be asked.
- **Memory.** The first third of the run is the warm-up: caches fill, and buffers grow to what the first floods and
  recoveries need. Of a process that ran all the time since, the median in the last third is not above the median in the
  second third by more than `GROWTH_MB`. It is the median, as a flood or a recovery takes more for a moment, whenever it
  comes. The first monitor is never killed, so that every run judges the memory of a monitor.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import NamedTuple

import msgspec

from benchmarks.soak.plan import PERIOD_MIN, Plan
from monitor_node.replay import backtest
from plant_node.record import simulate_record
from reactorwatch.contract.codec import encode
from reactorwatch.contract.messages_pb2 import Alarm, Health
from reactorwatch.records.record import MINUTE_NS
from recorder.tools.player import samples_of

SIGNALS = 3
SOON_ROWS = 20
SILENCE = "silence/"
UNDERWAY_ROWS = 3  # which may have been published when a blow was struck, beside the one that was known
ROW_NS = round(PERIOD_MIN * MINUTE_NS)


GROWTH_MB = 10.0
"""Allowed growth. In ten minutes with 200 plants a third is 240,000 samples: 42 bytes kept of each
are more. In an hour it is 7."""
OWN = ("RssAnon:", "RssShmem:")
"""Lines of a process's status: its own pages, and those of memory that it shares with other processes."""


class Taken(NamedTuple):
    """Memory that a process takes at one time."""

    row: int  # Row of the plants that was published last
    pid: int  # Number of the process; a restarted process has another one
    memory_mb: float  # Memory of the process's own in MB


def own_memory_mb(pid: int) -> float:
    """The memory that a process takes beside the files that it maps, in MB; 0 if it has ended.

    Pages of files, mainly of compiled libraries, are the system's to keep and to drop as it has room.
    """
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0.0
    return sum(int(line.split()[1]) for line in lines if line.startswith(OWN)) * 1024 / 1e6


def most_in_thirds(taken: Sequence[Taken], rows: int) -> tuple[float, float, float]:
    """The most memory in each third of the run, in MB."""
    first, middle, last = (max((item.memory_mb for item in third), default=0.0) for third in _thirds(taken, rows))
    return first, middle, last


def find_growth_mb(taken: Sequence[Taken], rows: int) -> float | None:
    """Growth of a process since the warm-up, in MB; None if it did not run all the time since."""
    _, middle, last = _thirds(taken, rows)
    if not middle or not last or len({item.pid for item in (*middle, *last)}) > 1:
        return None
    return median(item.memory_mb for item in last) - median(item.memory_mb for item in middle)


def _thirds(taken: Sequence[Taken], rows: int) -> list[list[Taken]]:
    """Split measurements by the third of the run in which they were made."""
    thirds: list[list[Taken]] = [[], [], []]
    for item in taken:
        thirds[min(3 * item.row // rows, 2)].append(item)
    return thirds


class Judged(NamedTuple):
    """Number of rows of a plant that were judged at one time."""

    time_s: float  # time of the computer's clock
    rows: int  # number of rows since the start of the plant
    start_s: float  # start of the monitor


class Strike(NamedTuple):
    """A blow to a cluster that was struck."""

    kind: str  # kind of the disturbance
    row: int  # row of the plants that was published last
    time_s: float  # time of the computer's clock
    plants: Sequence[str]  # plants of the shards that it may concern
    is_gradual: bool  # True if their monitors end some time after it

    def recovery_s(self, judged: Mapping[str, Sequence[Judged]]) -> float | None:
        """Time until a row that was published after the blow was judged of each plant; None: not all were."""
        row, start_s = self.row + UNDERWAY_ROWS, self.time_s if self.is_gradual else 0.0
        times = [
            next((item.time_s for item in judged.get(plant, ()) if item.rows > row and item.start_s >= start_s), None)
            for plant in self.plants
        ]
        return max(time_s - self.time_s for time_s in times if time_s is not None) if None not in times else None


def count_superseded(judged: Mapping[str, Sequence[Judged]]) -> int:
    """Count the plants with health of a monitor after that of its successor, which started half a second later."""
    return sum(any(b.start_s < a.start_s - 0.5 for a, b in pairwise(items)) for items in judged.values())


@dataclass(frozen=True)
class Placement:
    """Findings about the placement of shards on a cluster."""

    recoveries: list[tuple[str, float | None]]  # kind of each blow, and the seconds until all plants were judged again
    cpu_percent: dict[str, float]  # share of a core while nothing was disturbed; without the monitors themselves
    ends: list[tuple[str, float | None]]  # of each stop or cut, and of the scheduler: seconds from it being over to
    # the end of the last monitor from before; None: one did not end
    superseded: int  # number of plants with health of a monitor after that of its successor
    starts: dict[str, int]  # number of starts of each service
    skipped: str  # reason why no worker was cut off

    def failures(self, within_s: float, cpu_percent: float) -> Iterator[str]:
        """Yield a line for each broken promise."""
        for kind, after_s in self.recoveries:
            if after_s is None or after_s > within_s:
                yield f"{kind}: plants are judged again after {after_s} s"
        if (total := sum(self.cpu_percent.values())) > cpu_percent:
            yield f"the placement takes {total:.1f} % of a core"
        for kind, after_s in self.ends:
            if after_s is None:
                yield f"{kind}: a monitor from before does not end"
        if self.superseded:
            yield f"{self.superseded} plants have health of a monitor after that of its successor"


class Change(NamedTuple):
    """A change of an alarm."""

    time_ns: int
    alarm: str
    event: str


@dataclass(frozen=True)
class Findings:
    """Findings of a soak."""

    published: int  # samples of all plants
    rows: int  # number of evaluated rows
    incomplete: int  # number of incomplete rows among them
    lost: int  # samples that never reached the monitor of their plant
    late: int  # samples that came after their row was evaluated
    unaccounted: dict[str, str]  # for each plant with any
    duplicated: int  # repeated samples
    refused: dict[str, int]  # rejected messages of the plants, by reason
    garbage: int  # number of garbage messages
    stalls: int  # number of stalls of a monitor longer than a second
    lag_ms: float  # longest wait of a message in a monitor
    faults: int  # number of faults in the plants
    alarmed_once: int  # number of faults alarmed once
    not_once: dict[str, str]  # plants with a fault that was not alarmed once, with the reason
    false_alarms: dict[str, list[str]]  # alarms of each plant without a fault
    others: dict[str, list[str]]  # for each plant, changes of alarms that differ from those of an undisturbed monitor
    silences: int  # number of silences raised before the last row
    silences_raised_twice: int  # number of silences raised once more
    standing_silences: int  # number of silences that were not over in the end
    memory_mb: dict[str, tuple[float, float, float]]  # largest memory of each process in each third of the run
    grown_mb: dict[str, float]  # for each process that ran since the first third
    placement: Placement | None = None  # of shards on a cluster

    def failures(
        self, growth_mb: float = GROWTH_MB, recovery_s: float = 20.0, cpu_percent: float = 2.0
    ) -> Iterator[str]:
        """Yield a line for each broken promise."""
        for plant, samples in self.unaccounted.items():
            yield f"{plant}: samples unaccounted for: {samples}"
        if self.placement is not None:
            yield from self.placement.failures(recovery_s, cpu_percent)
            if self.lost or self.late:
                yield f"{self.lost} samples were lost and {self.late} late, all of which the publishers kept"
        if not bool(self.garbage) <= sum(self.refused.values()) <= self.garbage:
            yield f"{sum(self.refused.values())} messages were refused, of {self.garbage} garbage messages"
        for plant, why in self.not_once.items():
            yield f"{plant}: not alarmed once: {why}"
        for plant, raised in self.false_alarms.items():
            yield f"{plant}: alarms without a fault: {', '.join(raised)}"
        for plant, changes in self.others.items():
            yield f"{plant}: not as undisturbed: {', '.join(changes)}"
        if self.silences_raised_twice:
            yield f"{self.silences_raised_twice} silences were raised twice"
        if self.standing_silences:
            yield f"{self.standing_silences} silences stand"
        for name, grown in self.grown_mb.items():
            if grown > growth_mb:
                yield f"{name} grew by {grown:.1f} MB"


def count_unaccounted(health: Health, rows: int) -> int:
    """Count the samples of a plant that are neither in a row nor counted, or in a row without being published."""
    places = SIGNALS * health.rows
    fewest, most = places - (SIGNALS - 1) * health.incomplete_rows, places - health.incomplete_rows
    missing, too_many = SIGNALS * rows - most, fewest - SIGNALS * rows
    return max(missing - health.lost - health.late, too_many, 0)


def changes_of(alarms: Sequence[Alarm]) -> list[Change]:
    """Changes of the alarms of a plant, without silences."""
    return [
        Change(item.time_ns, item.alarm, item.event)
        for item in alarms
        if not item.alarm.startswith(SILENCE) and item.event in ("raised", "cleared")
    ]


def expected_changes(plan: Plan, plant: str, zero_ns: int) -> list[Change]:
    """Changes of alarms of a monitor that receives all samples of a plant and is never stopped."""
    config = plan.plant(plant, zero_ns)
    published = (encode(item) for item in samples_of(simulate_record(config), plant, zero_ns))
    return changes_of(backtest.run(published, msgspec.structs.replace(plan.monitor, plant=plant)).alarm_messages)


def why_not_once(changes: Sequence[Change], onset_ns: int) -> str | None:
    """Reason why a fault was not alarmed once; None if it was."""
    raised = [change for change in changes if change.event == "raised"]
    if not raised:
        return "no alarm"
    first_ns = min(change.time_ns for change in raised)
    if not onset_ns <= first_ns <= onset_ns + SOON_ROWS * ROW_NS:
        return f"the first alarm is {(first_ns - onset_ns) / ROW_NS:.0f} rows from the onset"
    standing: set[str] = set()
    for change in changes:
        if change.event == "raised" and change.alarm in standing:
            return f"{change.alarm} is raised again while it stands"
        (standing.add if change.event == "raised" else standing.discard)(change.alarm)
    return None


def assess(
    plan: Plan,
    zero_ns: int,
    alarms: Mapping[str, Sequence[Alarm]],
    health: Mapping[str, Health],
    lag_ms: float,
    garbage: int,
    memory: Mapping[str, Sequence[Taken]],
) -> Findings:
    """Assess a soak."""
    reports = [health.get(plant, Health()) for plant in plan.plants]
    refused: Counter[str] = Counter()
    missing: dict[str, str] = {}
    for plant, item in zip(plan.plants, reports, strict=True):
        refused.update(dict(item.refused_by_reason))
        if number := count_unaccounted(item, plan.rows):
            missing[plant] = (
                f"{number} ({item.rows} rows of {plan.rows}, {item.incomplete_rows} incomplete, "
                f"{item.lost} lost, {item.late} late)"
            )
    not_once: dict[str, str] = {}
    false_alarms: dict[str, list[str]] = {}
    others: dict[str, list[str]] = {}
    silences: list[tuple[str, str, str, int]] = []
    for plant, item in zip(plan.plants, reports, strict=True):
        said = list(alarms.get(plant, ()))
        silences += [(item.event, plant, item.alarm, item.raised_ns) for item in said if item.alarm.startswith(SILENCE)]
        changes, fault = changes_of(said), plan.faults.get(plant)
        if fault is None:
            if changes:
                false_alarms[plant] = [f"{change.alarm} {change.event}" for change in changes]
        elif (why := why_not_once(changes, zero_ns + fault.row * ROW_NS)) is not None:
            not_once[plant] = why
        if not (item.lost or item.late) and (
            different := _different(changes, expected_changes(plan, plant, zero_ns), zero_ns)
        ):
            others[plant] = different
    end_ns = zero_ns + plan.rows * ROW_NS
    events = {
        event: [item for item in silences if item[0] == event and item[3] < end_ns] for event in ("raised", "cleared")
    }
    raised, over = ({item[1:] for item in events[event]} for event in ("raised", "cleared"))
    return Findings(
        published=SIGNALS * plan.rows * len(plan.plants),
        rows=sum(item.rows for item in reports),
        incomplete=sum(item.incomplete_rows for item in reports),
        lost=sum(item.lost for item in reports),
        late=sum(item.late for item in reports),
        unaccounted=missing,
        duplicated=sum(item.duplicated for item in reports),
        refused=dict(refused),
        garbage=garbage,
        stalls=sum(item.stalls for item in reports),
        lag_ms=lag_ms,
        faults=len(plan.faults),
        alarmed_once=len(plan.faults) - len(not_once),
        not_once=not_once,
        false_alarms=false_alarms,
        others=others,
        silences=len(raised),
        silences_raised_twice=len(events["raised"]) - len(raised),
        standing_silences=len(raised - over),
        memory_mb={name: most_in_thirds(taken, plan.rows) for name, taken in memory.items()},
        grown_mb={
            name: grown for name, taken in memory.items() if (grown := find_growth_mb(taken, plan.rows)) is not None
        },
    )


def _different(changes: Sequence[Change], expected: Sequence[Change], zero_ns: int) -> list[str]:
    """Changes that are in one of the two and not in the other, or more often."""
    more, fewer = Counter(changes) - Counter(expected), Counter(expected) - Counter(changes)
    return [
        f"{sign}{change.alarm} {change.event} at row {(change.time_ns - zero_ns) // ROW_NS}"
        for sign, part in (("+", more), ("-", fewer))
        for change in sorted(part.elements())
    ]

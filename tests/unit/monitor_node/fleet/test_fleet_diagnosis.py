"""The trainings of a fleet queue for their diagnosis; each plant is judged by what it was before once that is known."""

import msgspec
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.fleet import FleetMonitor
from monitor_node.learn.training_diagnosis import FAILED, DiagnosisJob, Finding
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Sample
from reactorwatch.diagnosis.result import NOMINAL

from ..fleets import fleet, of, of_plant, row_by_row
from ..warm_plant import Run, changes, plant

CONFIG = MonitorConfig(training_min=40.0, isolation=False)
FOUND = 3 * 480
"""Number of each plant's sample at which the findings come, 80 rows after the training."""


class Queue(list[tuple[str, DiagnosisJob]]):
    """The diagnoses that a fleet's monitor asked for."""

    def submit(self, plant: str, job: DiagnosisJob) -> None:
        self.append((plant, job))


@pytest.fixture(scope="module")
def runs(warm: Run) -> dict[str, list[Encoded]]:
    sound = plant(seed=4), plant(seed=5)
    return {"warm": of_plant("warm", warm.messages)} | {
        name: of_plant(name, run) for name, run in zip("ab", sound, strict=True)
    }


def findings(queue: Queue, warm: Run) -> list[tuple[str, Finding]]:
    nominal = Finding(warm.finding.first_ns, NOMINAL, "it agrees")
    return [(name, warm.finding if name == "warm" else nominal) for name, _ in queue]


def part(runs: dict[str, list[Encoded]], first: int, end: int | None = None) -> list[Encoded]:
    return row_by_row([run[first:end] for run in runs.values()])


def publish(monitors: FleetMonitor, messages: list[Encoded]) -> list[Publication]:
    """Publications of a fleet that receives its messages some rows at a time, by a clock that goes on."""
    published = []
    for at in range(0, len(messages), 90):
        now_ns = Sample.FromString(messages[at].payload).time_ns
        published += monitors.on_messages(messages[at : at + 90], now_ns)
    return published


def own_monitor(name: str, messages: list[Encoded], finding: Finding | None) -> list[Publication]:
    monitor = Monitor(msgspec.structs.replace(CONFIG, plant=name), 0, points=False)
    published = [item for message in messages[:FOUND] for item in monitor.on_message(message, 0)]
    if finding is not None:
        monitor.pipeline.baselines.on_finding(finding)
    return published + [item for message in messages[FOUND:] for item in monitor.on_message(message, 0)]


def watched(runs: dict[str, list[Encoded]], queue: Queue) -> FleetMonitor:
    monitors = fleet(CONFIG, diagnose=queue.submit)
    for name in runs:
        monitors.register(name, 0, verified=True)
    return monitors


def test_a_fleet_publishes_of_each_plant_what_its_own_monitor_does(runs: dict[str, list[Encoded]], warm: Run) -> None:
    queue = Queue()
    monitors = watched(runs, queue)
    published = publish(monitors, part(runs, 0, FOUND))
    for name, finding in reversed(findings(queue, warm)):
        monitors.on_finding(name, finding)
    published += publish(monitors, part(runs, FOUND))
    assert len(queue) == 3
    assert len(changes(of("warm", published))) == 1
    for name, run in runs.items():
        assert of(name, published) == of(name, own_monitor(name, run, dict(findings(queue, warm))[name]))


def restart(before: FleetMonitor, queue: Queue) -> FleetMonitor:
    """Another monitor that resumes from the states of one that was stopped."""
    after = fleet(CONFIG, diagnose=queue.submit)
    for name in before.plants:
        state = before.monitor(name).to_bytes()
        after.register(name, 0, verified=True, restore=lambda monitor, state=state: monitor.from_bytes(state))  # type: ignore[misc]
        after.monitor(name).on_history_end()
    return after


def test_a_diagnosis_that_is_pending_at_a_restart_is_submitted_again(runs: dict[str, list[Encoded]], warm: Run) -> None:
    before, after = Queue(), Queue()
    first = watched(runs, before)
    published = publish(first, part(runs, 0, FOUND))
    second = restart(first, after)
    assert sorted(after) == sorted(before)
    for name, finding in findings(after, warm):
        second.on_finding(name, finding)
    published += publish(second, part(runs, FOUND))
    for name, run in runs.items():
        assert of(name, published) == of(name, own_monitor(name, run, dict(findings(after, warm))[name]))


def test_a_diagnosis_that_failed_leaves_its_plant_and_the_others_as_they_are(
    runs: dict[str, list[Encoded]], warm: Run
) -> None:
    queue = Queue()
    monitors = watched(runs, queue)
    published = publish(monitors, part(runs, 0, FOUND))
    for name, _ in queue:
        monitors.on_finding(name, Finding(warm.finding.first_ns, FAILED, "the worker died"))
    published += publish(monitors, part(runs, FOUND))
    for name, run in runs.items():
        assert of(name, published) == of(name, own_monitor(name, run, None))
    assert len(queue) == 3

"""A diagnosis takes a bounded number of filter runs and linearisations; seconds depend on the machine."""

from collections import Counter
from dataclasses import dataclass

import pytest

from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.kalman.ekf import Filter
from reactorwatch.kalman.error_dynamics import ErrorLinearization
from reactorwatch.process.library.cstr import cstr
from tests.unit.diagnosis.runs import record_of


@dataclass(frozen=True)
class Effort:
    """Largest numbers of filter runs and of linearisations."""

    runs: int
    linearisations: int


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    counts: Counter[str] = Counter()
    run, linearise = Filter.run_batched, ErrorLinearization.dynamics

    def count_run(self, record, start=None):  # type: ignore[no-untyped-def]
        counts["runs"] += 1
        return run(self, record, start)

    def count_linearisation(self, *items, **named):  # type: ignore[no-untyped-def]
        counts["linearisations"] += 1
        return linearise(self, *items, **named)

    monkeypatch.setattr(Filter, "run_batched", count_run)
    monkeypatch.setattr(ErrorLinearization, "dynamics", count_linearisation)
    return counts


@pytest.mark.parametrize(
    ("faults", "effort"),
    [
        ((), Effort(110, 6)),
        (("coolant_flow:step:-0.05@30min",), Effort(300, 60)),
        (("coolant_flow:step:-0.05@30min", "temperature_bias:ramp:2@20min,end=90min"), Effort(900, 260)),
    ],
    ids=("nominal", "one cause", "pair"),
)
def test_a_diagnosis_is_a_limited_effort(faults: tuple[str, ...], effort: Effort, counted: Counter[str]) -> None:
    found = diagnose(record_of(*faults, rows=900), cstr())
    assert len(found.causes) == len(faults)
    assert counted["runs"] <= effort.runs
    assert counted["linearisations"] <= effort.linearisations

"""The phase plane: the path, and the steady states of the equations that it is seen among."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from reactorwatch.process.model import ProcessModel
from reactorwatch.process.steady_state import SteadyState, steady_states
from recorder.columns import RunColumns, SampleColumns, SignalStatistics, read_run, read_segments
from recorder.panels import phase_plane
from recorder.panels.base import STABLE, UNSTABLE, PlanePlot
from tests.tables import UNITS
from tests.unit.recorder import golden

# at qc = 103.41 l/min: C in mol/l, T in K, and whether it is stable (docs/plant.md; solved by hand from the equations)
AT_103 = [(0.96389, 353.553, True), (0.47622, 401.530, False), (0.1000129, 438.5417, True)]


@pytest.fixture(scope="module")
def run() -> RunColumns:
    return read_run(golden.entries())


def at(run: RunColumns, coolant_flow: float) -> RunColumns:
    """The run at another mean of the coolant flow."""
    return replace(
        run,
        statistics={
            **run.statistics,
            "qc": SignalStatistics(300, coolant_flow, coolant_flow - 1.0, coolant_flow + 1.0),
        },
    )


def both(run: RunColumns) -> tuple[PlanePlot, PlanePlot]:
    near, far = phase_plane.draw(run)
    return near, far


def test_nothing_is_drawn_of_a_process_that_is_not_known(run: RunColumns) -> None:
    strange = {name: run.statistics[other] for name, other in (("u", "qc"), ("y", "T"), ("z", "C"))}
    assert phase_plane.draw(replace(run, statistics=strange)) == ()
    assert phase_plane.draw(replace(run, statistics={"T": run.statistics["T"]})) == ()


def test_all_steady_states_at_the_coolant_flow_of_the_run_are_marked_stable_or_not(run: RunColumns) -> None:
    near, far = both(at(run, 103.41))
    marks = {mark.name: mark for mark in far.marks}
    for (c, t, stable), mark in zip(AT_103, far.marks, strict=True):
        assert mark.y == pytest.approx(t, abs=0.01)
        assert mark.x == pytest.approx(c, abs=2e-4)
        assert mark.colour == (STABLE if stable else UNSTABLE)
        assert (mark.name == "saddle") is not stable
    assert list(marks) == ["stable node", "saddle", "stable focus"]
    assert [mark.name for mark in near.marks] == ["stable focus"], "close by there is but the one it is operated at"
    assert "qc = 103.4 l/min" in far.note


def test_the_operating_branch_goes_through_the_steady_states_of_other_flows(run: RunColumns) -> None:
    """The table of docs/plant.md; past 111 l/min the branch loses its stability."""
    seen = {**run.statistics, "qc": SignalStatistics(300, 100.0, 85.0, 115.0)}
    near, _ = both(replace(run, statistics=seen))
    curves = {curve.name: curve for curve in near.curves}
    points = np.column_stack([curves["stable branch"].x, curves["stable branch"].y])
    for c, t in ((0.0521787, 452.4796), (0.0620407, 448.7522), (0.0882316, 441.2184), (0.1298253, 432.9487)):
        assert np.nanmin(np.abs(points - (c, t)) @ (1.0, 0.001)) < 1e-4
    unstable = curves["unstable branch"]
    beyond = np.isfinite(unstable.x) & (unstable.x > 0.1381)
    assert beyond.any()
    assert not np.isfinite(curves["stable branch"].x[beyond]).any()


def test_where_the_branch_ends_nothing_is_made_up(run: RunColumns) -> None:
    """At 120 l/min only the extinguished state is left, and no line jumps down to it."""
    near, far = both(replace(run, statistics={**run.statistics, "qc": SignalStatistics(300, 105.0, 90.0, 130.0)}))
    for curve in near.curves:
        assert np.nanmax(curve.x) < 0.3
    assert len(far.marks) == 3


def test_a_flow_that_the_equations_do_not_know_has_no_steady_states(run: RunColumns) -> None:
    near, far = both(at(run, 80_000.0))
    assert (near.curves, near.marks, far.marks) == ((), (), ())
    assert near.paths


def test_the_path_changes_colour_while_the_alarm_stands_without_a_break(run: RunColumns) -> None:
    plane, _ = both(run)
    quiet, alarmed = plane.paths
    assert (quiet.name, alarmed.name) == ("no alarm", "alarm active")
    raised, cleared = (round(minutes / golden.STEP_MIN) for minutes in (golden.RAISED_MIN, golden.CLEARED_MIN))
    rows = np.arange(golden.ROWS)
    assert np.array_equal(np.isfinite(alarmed.x), (rows >= raised - 1) & (rows < cleared))
    assert np.array_equal(np.isfinite(quiet.x), (rows < raised) | (rows >= cleared - 1))
    steps = [np.isfinite(path.x[:-1]) & np.isfinite(path.x[1:]) for path in plane.paths]
    assert (steps[0] ^ steps[1]).all()  # every step is drawn, once


def steps(planes: Iterable[PlanePlot]) -> dict[str, set[tuple[float, ...]]]:
    """What is drawn from row to row, by the name of the path."""
    found: dict[str, set[tuple[float, ...]]] = {}
    for path in (path for plane in planes for path in plane.paths):
        lines = np.column_stack([path.x[:-1], path.y[:-1], path.x[1:], path.y[1:]])
        found.setdefault(path.name, set()).update(map(tuple, lines[np.isfinite(lines).all(axis=1)].tolist()))
    return found


@pytest.mark.parametrize("each", [37, 250, 1000])
def test_stretch_by_stretch_the_path_is_the_same_wherever_it_is_cut(run: RunColumns, each: int) -> None:
    """But for the colour of a step at a cut, whose alarm is heard of in the next stretch only."""
    whole = steps([both(run)[0]])
    drawn = steps(near for part in read_segments(golden.entries(), each) for near in phase_plane.draw(part)[:1])
    assert set().union(*drawn.values()) == set().union(*whole.values())
    assert len(drawn["alarm active"] ^ whole["alarm active"]) <= 2


def test_the_steady_states_of_a_run_are_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    solved: list[float] = []

    def count(model: ProcessModel, level: NDArray[np.float64]) -> list[SteadyState]:
        solved.append(float(level[0]))
        return steady_states(model, level)

    phase_plane.steady_states_at.cache_clear()
    monkeypatch.setattr(phase_plane, "steady_states", count)
    drawn = [phase_plane.draw(part) for part in read_segments(golden.entries(), 100)]
    assert len({(planes[1].note, planes[1].marks) for planes in drawn if planes}) == 1
    assert sum(bool(planes) for planes in drawn) > 3
    assert len(solved) == len(set(solved))


def test_the_plane_marks_the_fault_and_the_first_alarm(run: RunColumns) -> None:
    plane, _ = both(run)
    assert (plane.x_label, plane.y_label) == ("C, mol/l", "T, K")
    places = {mark.name: (mark.x, mark.y) for mark in plane.events}
    for name, minutes in (("onset of the fault", golden.ONSET_MIN), ("first alarm", golden.RAISED_MIN)):
        row = round(minutes / golden.STEP_MIN)
        assert places[name] == (golden.value("C", row), golden.value("T", row))


def test_of_very_many_rows_the_farthest_are_drawn() -> None:
    rows = 50_000
    rng = np.random.default_rng(4)
    columns = {"qc": np.full(rows, 100.0), "C": 0.1 + 0.01 * rng.normal(size=rows), "T": 440.0 + rng.normal(size=rows)}
    columns["T"][12_345], columns["C"][30_001] = 470.0, 0.25
    times = np.arange(rows, dtype=np.int64) * 6 * 10**9
    seen = {
        name: SignalStatistics(rows, float(v.mean()), float(v.min()), float(v.max())) for name, v in columns.items()
    }
    measured = {name: SampleColumns(times, values) for name, values in columns.items()}
    near, _ = both(RunColumns("cstr", UNITS, measured, {}, {}, (), (), statistics=seen))
    (path,) = near.paths
    assert path.x.size <= phase_plane.MAX_POINTS
    assert (path.y.max(), path.x.max()) == (470.0, 0.25)
    assert path.y.min() == columns["T"].min()

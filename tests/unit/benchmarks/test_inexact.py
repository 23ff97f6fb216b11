"""Inexact records are those of the published equations but for what their truth states, and their scores are strict."""

import re
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

import reactorwatch as rw
from benchmarks.diagnosis_study import FIRST_SEED
from benchmarks.harness.study import Pool
from benchmarks.hidden.classes import NEARLY, draw_record, find_class
from benchmarks.inexact import foreign, reactor
from benchmarks.inexact.records import Cause, write_files
from benchmarks.inexact.scores import score, table
from benchmarks.inexact.two_heaters import KINDS, PAIRS, _heat, draw, kinds_of, process_file
from reactorwatch.description.read import find_process

TRUTH = {"group": "lag", "cause": Cause(("a", "b"), (0.2, 0.21), "1", 10.0)._asdict(), "period_min": 0.1}
SOUND = {"group": "lag", "cause": None, "period_min": 0.1}


def named(cause: str, size: float = 0.2, onset: float = 10.0) -> dict[str, Any]:
    """A cause as `diagnose --json` prints it."""
    return {"cause": cause, "parameters": {"size": {"value": size}, "onset": {"value": onset}}}


def found(*causes: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A diagnosis that names causes."""
    verdict = "named" if causes else "unknown"
    return {"verdict": verdict, "causes": list(causes), "alternatives": [], "practical": True} | more


def test_a_record_of_two_heaters_is_the_simulation_of_the_page_but_for_its_rounding(tmp_path: Path) -> None:
    drawn = draw(1, 7, sound=True)
    assert drawn.inexact == {"kinds": ("quantised",)}
    path, process = write_files(drawn, tmp_path)
    noise_sd = np.hypot(0.1, 0.25 / np.sqrt(12.0))
    rmse = rw.simulate(rw.read_record(path, process=process)).rmse
    assert [rmse[name].value for name in ("T1", "T2")] == pytest.approx([noise_sd] * 2, rel=0.06)


@pytest.mark.parametrize("name", foreign.PLANTS)
def test_a_process_file_has_the_equations_of_the_simulator_of_others(name: str) -> None:
    if name == "four_tanks":
        if not foreign.PCGYM.exists():
            pytest.skip("pcgym is not installed (python -m benchmarks.inexact.foreign)")
    else:
        pytest.importorskip(
            {"tclab_simulator": "tclab", "van_de_vusse": "do_mpc"}[name], reason="needs the group peers"
        )
    plant, rows = foreign.PLANTS[name], foreign.SETTLING_ROWS + 60
    levels = np.array(list(plant["inputs"].values()))
    inputs = np.where(np.arange(rows)[:, None] < foreign.SETTLING_ROWS + 10, levels @ [0.7, 0.3], levels @ [0.4, 0.6])
    halves = [(plant["constants"], inputs[:200]), (plant["constants"], inputs[200:])]
    measured = foreign.SIMULATORS[name](halves, np.zeros((rows, len(plant["noise"]))))[foreign.SETTLING_ROWS :]
    signals = dict(zip(plant["inputs"], inputs[foreign.SETTLING_ROWS :].T, strict=True))
    signals |= dict(zip(plant["noise"], measured.T, strict=True))
    process = str(foreign.FOLDER / "processes" / f"{name}.py")
    record = rw.Record(time_min=plant["period_s"] / 60.0 * np.arange(60.0), signals=signals, process=process)
    rounding = 0.3223 if name == "tclab_simulator" else 0.0  # down, so that the mean is half of it
    for output, error in rw.simulate(record).rmse.items():
        assert error.value < 0.6 * rounding + 0.01 * plant["noise"][output]


def test_a_seed_draws_the_same_records_of_the_reactor_as_the_study() -> None:
    drawn, hidden = reactor.draw(1, 5, sound=False), draw_record(find_class(NEARLY), 5, FIRST_SEED)
    np.testing.assert_array_equal(drawn.columns["T"], hidden.record.columns["T"])
    assert drawn.cause is not None
    assert drawn.cause.names == hidden.causes


def test_the_two_heaters_have_the_equations_of_the_page(tmp_path: Path) -> None:
    file = tmp_path / "tclab.py"
    file.write_text(process_file(), encoding="utf-8")
    model = find_process(str(file)).equations
    assert model is not None
    symbols = [ca.vertcat(*(item.symbol for item in part)) for part in (model.states, model.inputs, model.parameters)]
    rhs = ca.Function("rhs", symbols, [ca.vertcat(*model.rhs)])
    T, powers, constants = np.array([50.0, 40.0]), np.array([70.0, 20.0]), np.array([11.0, 20.0, 0.012, 0.007])
    np.testing.assert_allclose(
        60.0 * _heat(constants, T, powers) / 2.0, rhs(T, powers, constants).full().ravel(), rtol=1e-12
    )


def test_forty_records_have_every_class_pair_and_cause() -> None:
    kinds = [kinds_of(1, number) for number in range(40)]
    assert {item[0] for item in kinds if len(item) == 1} == set(KINDS)
    assert {item for item in kinds if len(item) == 2} == set(PAIRS)
    names = {cause.names[0] for number in range(6) if (cause := draw(1, number, sound=False).cause)}
    assert {re.sub(r"\d", "", name) for name in names} == {"U.deviation", "alpha.deviation", "T.bias", "Ta.deviation"}


def test_a_seed_draws_the_same_record_again_and_a_sound_one_has_no_cause(tmp_path: Path) -> None:
    paths = [write_files(draw(3, 4, sound=False), tmp_path / name)[0] for name in "ab"]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert draw(3, 4, sound=True).cause is None


@pytest.mark.parametrize(
    ("diagnosis", "first", "leads", "listed"),
    [
        (found(named("a")), True, True, True),
        (found(named("b")), True, True, True),
        (found(named("a"), named("c")), False, True, False),
        (found(named("c"), alternatives=[{"causes": [named("a")]}]), False, False, True),
        (found(nearest=[named("a"), named("c")]), True, True, True),
        (found(nearest=[{"causes": [named("c")]}, {"causes": [named("b")]}]), False, False, True),
        (found(verdict="nominal", nearest=[named("a")]), False, False, False),
        (found(), False, False, False),
    ],
)
def test_only_the_true_cause_alone_is_right(diagnosis: dict[str, Any], first: bool, leads: bool, listed: bool) -> None:
    result = score(TRUTH, diagnosis)
    assert (result["first"], result["leads"], result["listed"]) == (first, leads, listed)


def test_sizes_and_onsets_are_those_of_the_right_explanation() -> None:
    result = score(TRUTH, found(named("c", 9.0), alternatives=[{"causes": [named("b", 0.21, 10.15)]}]))
    assert result["size_error"] == 0.0
    assert result["onset_error_rows"] == pytest.approx(1.5)
    assert result["size"]
    assert result["onset"]
    assert score(TRUTH, found())["size_error"] is None
    assert not score(TRUTH, found())["onset"]


@pytest.mark.parametrize(
    ("diagnosis", "claimed"),
    [
        (found(named("a")), True),
        (found(named("a"), practical=False), False),
        (found(named("a"), practical=False, grade="mostly"), True),
        (found(nearest=[named("a")], grade="nearest"), False),
    ],
)
def test_a_sound_record_is_claimed_by_causes_that_matter_in_practice(diagnosis: dict[str, Any], claimed: bool) -> None:
    result = score(SOUND, diagnosis)
    assert result["claimed"] is claimed
    assert "| sound            | 1 | –" in table([{"truth": SOUND, "score": result, "cpu_s": 1.0}])


def test_results_in_a_file_of_lines_are_not_computed_again(tmp_path: Path) -> None:
    file = tmp_path / "results.jsonl"
    assert Pool(1, results=file).run("squares", _square, [2, 3]) == [{"square": 4}, {"square": 9}]
    file.write_bytes(file.read_bytes()[:-5])
    assert Pool(1, results=file).run("squares", _no_two, [2, 3]) == [{"square": 4}, {"square": 9}]


def _square(number: int) -> dict[str, int]:
    return {"square": number**2}


def _no_two(number: int) -> dict[str, int]:
    assert number != 2
    return _square(number)

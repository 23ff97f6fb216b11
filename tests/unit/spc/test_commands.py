"""`charts arl` and `charts design`."""

import json

import pytest
from typer.testing import CliRunner

from reactorwatch.cli.main import app
from reactorwatch.errors import InputError


def run_charts(command: str) -> str:
    result = CliRunner().invoke(app, ["charts", *command.split()], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.parametrize(
    ("command", "length"),
    [
        ("shewhart --rules 1,2,3,4 --shift 0.2", 66.80),
        ("cusum --k 0.5 --h 4 --shift 1", 8.38),
        ("cusum --k 0.5 --h 4 --headstart 2 --shift 1", 5.29),
        ("cusum --k 0.5 --h 4 --shift 0", 167.684),
        ("cusum --k 0.5 --h 5 --one-sided", 930.89),
        ("cusum --k 0.5 --h 4 --shift 1 --steady-state", 7.68),
        ("ewma --lambda 0.25 --limit 3 --shift 1", 11.154267),
        ("mewma --dimension 2 --lambda 0.1 --limit 8.64 --shift 1", 10.12),
        ("t2 --dimension 2 --limit 10.597 --shift 1", 41.92),
    ],
)
def test_arl_prints_one_number(command: str, length: float) -> None:
    """The published one; sources as in `published.py`."""
    assert float(run_charts(f"arl {command}")) == pytest.approx(length, rel=0.006)


def test_arl_prints_an_object_for_machines() -> None:
    found = json.loads(run_charts("arl ewma --lambda 0.25 --limit 3 --shift 1 --json"))
    assert found.pop("arl") == pytest.approx(11.154267)
    assert found == {"chart": "ewma", "lambda": 0.25, "limit": 3.0, "shift": 1.0}


def test_what_design_prints_has_the_run_length_asked_for() -> None:
    found = json.loads(run_charts("design cusum --arl0 370.4 --shift 1 --json"))
    k, h = found["parameters"]["k"], found["parameters"]["h"]
    assert float(run_charts(f"arl cusum --k {k} --h {h}")) == pytest.approx(370.4, rel=1e-6)
    text = run_charts("design cusum --arl0 370.4 --shift 1").split()
    assert text[:3] == ["cusum", "k", "0.5"]


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("arl shewhart --rules one", "--rules must be some of 1,2,3,4 with commas between, got 'one'"),
        ("arl shewhart --rules 7", "rules must be some of 1, 2, 3, 4, got"),
        ("design cusum --arl0 1 --shift 1", r"arl0 must be in \[5, 1e\+08\], got 1.0"),
        ("design ewma --arl0 500 --shift 0", r"shift must be in \[0.1, 10\], got 0.0"),
        ("design median --arl0 500 --shift 1", "chart must be one of shewhart, ewma, cusum, t2, mewma, got 'median'"),
    ],
)
def test_wrong_input_is_reported_in_one_line(command: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as refused:
        run_charts(command)
    assert "\n" not in str(refused.value)

"""Sample records: their truth is what is in them."""

from typing import Any

import numpy as np
import pytest

import reactorwatch as rw
from reactorwatch.cli.examples import make_example
from reactorwatch.errors import InputError
from reactorwatch.process import OPERATIONS
from reactorwatch.process.library.cstr_operation import BOILING_FROM_K

SEED = 3
EXAMPLES = [name for item in OPERATIONS.values() for name, example in item.examples.items() if example.law is None]


def faults_of(truth: dict[str, Any], end_min: float) -> list[str]:
    """Specifications of the faults that a truth states."""
    texts = []
    for item in truth["causes"]:
        end = f",end={end_min}min" if item["profile"] == "ramp" else ""
        texts.append(f"{item['cause']}:{item['profile']}:{item['size']}@{item['onset_min']}min{end}")
    return texts


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_simulation_with_the_stated_causes_leaves_the_noise(name: str) -> None:
    record, truth, _ = make_example(name, SEED)
    simulated = rw.simulate(record, truth["process"], faults=faults_of(truth, float(record.time_min[-1])))
    noise_sd = OPERATIONS[truth["process"]].noise_sd
    assert noise_sd
    for signal, sd in ((signal, sd) for signal, sd in noise_sd.items() if sd):
        rmse = np.sqrt(np.mean((record.columns[signal] - simulated.columns[signal]) ** 2))
        assert 0.9 * sd < rmse < 1.2 * sd, f"{signal}: {rmse:g}"


@pytest.mark.parametrize("name", ["leak", "fouling", "analyser_drift"])
def test_a_backtest_names_the_hidden_cause_and_contains_no_error_of_this_software(name: str) -> None:
    record, truth, _ = make_example(name, SEED)
    result = rw.backtest(record)
    assert "error of this software" not in result.text
    (cause,) = truth["causes"]
    assert cause["cause"] in {item.cause for alarm in result.alarms for item in alarm.suspect[:1]}


def test_the_unknown_law_cools_the_contents_where_they_are_hot() -> None:
    record, truth, _ = make_example("unknown", SEED)
    simulated = rw.simulate(record).columns["T"]
    error, hot = record.columns["T"] - simulated, simulated > BOILING_FROM_K + 2.0
    assert truth["causes"] == []
    assert "max(T - 440 K, 0)" in truth["law"]
    assert np.mean(error[hot]) < -0.5


def test_the_truth_names_the_process_the_seed_and_every_cause() -> None:
    _, truth, _ = make_example("two_causes", SEED)
    assert (truth["process"], truth["seed"]) == ("cstr", SEED)
    assert [(item["cause"], item["unit"]) for item in truth["causes"]] == [
        ("coolant_flow", "1"),
        ("temperature_bias", "K"),
    ]


def test_another_seed_gives_another_record_and_the_same_seed_the_same() -> None:
    first, again, other = (make_example("leak", seed)[0].columns["T"] for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_an_unknown_name_is_refused_with_the_valid_ones() -> None:
    with pytest.raises(InputError, match=r"did you mean 'leak'\? \(valid: sound, leak"):
        make_example("leek", SEED)

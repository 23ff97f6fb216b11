"""The stated detectable deviations are those that the monitor detects, by injected faults."""

from functools import lru_cache

import pytest

from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.codec import Encoded, encode
from reactorwatch.results.promise import Power
from recorder.tools.player import samples_of

FACTOR, RUNS, HORIZON_MIN, ONSET_MIN = 1.3, 8, 10.0, 5.0
OF_OUTPUTS = {"T.bias": "temperature_bias", "C.bias": "concentration_bias"}
CASES = [
    ("equations", "coolant_flow"),
    ("equations", "temperature_bias"),
    ("arx", "T.bias"),
]


def messages(rows: int, seed: int, *faults: str) -> list[Encoded]:
    record = simulate_record(PlantConfig(seed=seed, faults=faults), rows)
    return [encode(item) for item in samples_of(record, "cstr")]


def settings(reference: str, *, isolation: bool) -> MonitorConfig:
    return MonitorConfig(
        reference=reference,  # type: ignore[arg-type]
        diagnose_training=False,
        training_min=60.0,
        isolation=isolation,
    )


@lru_cache(maxsize=6)
def trained(reference: str, *, isolation: bool) -> backtest.TrainedPlant:
    return backtest.train(messages(600, 1), settings(reference, isolation=isolation))


def stated(reference: str) -> dict[tuple[str, str], Power]:
    """Deviations that would be seen; without the search for causes they are biases of outputs with equations, too."""
    quick = settings(reference, isolation=True)
    result = backtest.run(messages(30, 2), quick, trained=trained(reference, isolation=True))
    return {(item.deviation, item.profile): item for item in result.power}


def share_seen(reference: str, cause: str, size: float) -> float:
    """Share of runs in which a step raises an alarm within the horizon; its sign alternates."""
    quick, seen = settings(reference, isolation=False), 0
    for number in range(RUNS):
        signed = size if number % 2 else -size
        fault = f"{OF_OUTPUTS.get(cause, cause)}:step:{signed!r}@{ONSET_MIN}min"
        rows = messages(round(10 * (ONSET_MIN + HORIZON_MIN)), 100 + number, fault)
        result = backtest.run(rows, quick, trained=trained(reference, isolation=False))
        seen += any(alarm.raised_ns / 60e9 >= ONSET_MIN for alarm, _ in result.raised_alarms)
    return seen / RUNS


@pytest.mark.parametrize(("reference", "cause"), CASES)
def test_a_step_of_the_stated_size_is_seen_in_time_to_within_a_factor(reference: str, cause: str) -> None:
    """A larger one in nine of ten runs and more; a smaller one is missed now and then."""
    size = stated(reference)[cause, ""].within_10_min
    assert size is not None
    assert share_seen(reference, cause, FACTOR * size) >= 0.9
    assert share_seen(reference, cause, size / FACTOR) <= 0.9


def test_longer_horizons_show_smaller_deviations_and_a_ramp_has_the_sizes_of_a_day() -> None:
    for (_, profile), item in stated("equations").items():
        if item.within_10_min is not None:
            assert item.within_1_h is not None
            assert item.within_1_day is not None
            assert item.within_10_min > item.within_1_h > item.within_1_day > 0.0
            assert not profile or item.within_10_min > 50.0 * item.within_1_day


def test_every_cause_that_alarms_are_traced_to_is_stated_as_step_and_ramp() -> None:
    found = stated("equations")
    names = {name for name, _ in found}
    assert len(names) == 13
    assert set(found) == {(name, profile) for name in names for profile in ("", "ramp")}
    assert found["coolant_flow", ""].unit == "1"


@pytest.mark.parametrize("reference", ["black-box", "arx"])
def test_without_equations_biases_of_the_outputs_are_stated_in_their_units(reference: str) -> None:
    found = stated(reference)
    assert {name for name, _ in found} == {"C.bias", "T.bias"}
    assert found["T.bias", ""].unit == "K"
    assert found["C.bias", "ramp"].within_1_day is not None

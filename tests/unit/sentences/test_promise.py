"""The power of a plant in words: steps that are seen within an hour, and the sizes of one deviation."""

import pytest

from reactorwatch.results.promise import Power
from reactorwatch.sentences.promise import describe_power, describe_sizes


def power(deviation: str, within_1_h: float | None, profile: str = "") -> Power:
    return Power(
        deviation=deviation,
        unit="K",
        profile=profile,
        within_10_min=None,
        within_1_h=within_1_h,
        within_1_day=0.1,
    )


NONE = "none stated: only charts of values watch, or none within its bounds is seen"


@pytest.mark.parametrize(
    ("stated", "text"),
    [
        ([power("T.bias", 0.214)], "T.bias 0.21 K"),
        ([power("T.bias", None)], "none; within a day: T.bias 0.1 K"),
        ([], NONE),
        ([power("T.bias", 0.2, "ramp")], NONE),
        ([power("heat_loss", 0.2)], "heat_loss 0.2 K; not stated: causes with states of their own or jumps, as lags"),
    ],
)
def test_the_steps_of_an_hour_are_stated_else_those_of_a_day_and_that_others_are_not(
    stated: list[Power], text: str
) -> None:
    assert describe_power(stated) == text


@pytest.mark.parametrize(("profile", "unit"), [("", "K"), ("ramp", "K, ramp by its size in a day")])
def test_the_sizes_of_a_deviation_are_stated_by_horizon(profile: str, unit: str) -> None:
    text = f"T.bias ({unit}): none within 10 min, 0.21 within an hour, 0.1 within a day"
    assert describe_sizes(power("T.bias", 0.21, profile)) == text

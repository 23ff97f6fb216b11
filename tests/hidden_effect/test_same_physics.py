"""Each effect of the software makes of the plant what the equations written out by hand here make of it."""

import numpy as np
import pytest

from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.profiles import Step
from reactorwatch.diagnosis.run import Run
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr import EFFECTS, OPERATING_COOLANT_FLOW, cstr
from reactorwatch.process.profiles import CONSTANT, STEP, Profile
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import steady_states
from tests.hidden_effect.catalogue import CATALOGUE, open_constants
from tests.hidden_effect.courses import Array, HiddenCourse
from tests.hidden_effect.plant import Plan, play

HAND = {item.name: item for item in CATALOGUE}
KNOWN = [item for item in EFFECTS if item.name in HAND]
TIME: Array = 0.1 * np.arange(300, dtype=np.float64)
COMMAND: Array = np.repeat(np.random.default_rng(7).uniform(93.0, 108.0, 30), 10)
COMMAND[:10] = OPERATING_COOLANT_FLOW
ONSET_MIN = 12.537

OF_ORDER_ONE = np.array([0.002, 0.3])

LAGS = ("jacket_lag", "valve_lag", "temperature_lag")
APPROXIMATE = {"concentration_delay": 0.01}
"""Of what an effect makes: the past is remembered by some polynomials."""

QUICK_LAG, QUICK_DELAY = 0.15, 0.06
"""The same of a lag or a delay much shorter than a row."""


def relative_error(effect: Effect, size: float, profile: Profile = CONSTANT) -> float:
    """Error of the software's run relative to the effect; the worse of C and T."""
    changes = {f"{effect.name}.size": size} | ({f"{effect.name}.onset": ONSET_MIN} if profile is STEP else {})
    model = effect.extend(cstr(), profile).with_values(changes)
    # By hand the plant has been running at the first flow for half an hour: it is at rest.
    course = HiddenCourse(profile.name, size, ONSET_MIN)
    by_hand = play(Plan(TIME, COMMAND, {effect.name: course}, constants=open_constants()))
    rest = steady_states(model, np.array([OPERATING_COOLANT_FLOW]))
    start = min((item.state for item in rest), key=lambda state: abs(state[1] - by_hand.state[0, 1]))
    found = Simulator(model).run(TIME, COMMAND[:, None], start).outputs
    shown = np.stack([by_hand.concentration, by_hand.temperature], axis=1)
    nominal = play(Plan(TIME, COMMAND))
    made = np.stack([nominal.concentration, nominal.temperature], axis=1) - shown
    off, size_of_it = (np.sqrt(np.mean((item / OF_ORDER_ONE) ** 2, axis=0)).max() for item in (found - shown, made))
    assert size_of_it > 0.1
    return float(off / size_of_it)


@pytest.mark.parametrize("profile", [CONSTANT, STEP], ids=lambda item: item.name)
@pytest.mark.parametrize("effect", KNOWN, ids=lambda item: item.name)
def test_an_effect_matches_the_equations_by_hand(effect: Effect, profile: Profile) -> None:
    hand = HAND[effect.name]
    size = hand.largest if effect.name in LAGS else hand.signs[0] * (hand.smallest * hand.largest) ** 0.5
    # Where a step sets in between two rows, a lag begins with what has been there since the row began.
    bound = APPROXIMATE.get(effect.name, 1e-3 if effect.name in LAGS and profile is STEP else 1e-5)
    assert relative_error(effect, size, profile) < bound


@pytest.mark.parametrize(
    "effect", [item for item in KNOWN if item.name in (*LAGS, "concentration_delay")], ids=lambda item: item.name
)
def test_a_lag_shorter_than_a_row_is_right_but_for_its_shape(effect: Effect) -> None:
    bound = QUICK_LAG if effect.name in LAGS else QUICK_DELAY
    assert relative_error(effect, HAND[effect.name].smallest) < bound


@pytest.mark.parametrize("onset_min", [ONSET_MIN, 12.9701, 13.0])
@pytest.mark.parametrize("size", [0.06, 0.1])
def test_a_filter_that_knows_when_the_stamps_became_late_has_nothing_to_correct(size: float, onset_min: float) -> None:
    """The command changes at 13 min."""
    timing = next(item for item in EFFECTS if item.name == "sample_timing")
    by_hand = play(Plan(TIME, COMMAND, {"sample_timing": HiddenCourse("step", size, onset_min)}))
    run = Run(TIME, COMMAND[:, None], np.stack([by_hand.concentration, by_hand.temperature], axis=1))
    knowing = FaultFilter(cstr(), (timing,), Noise((0.002, 0.3), (0.001, 0.3)))
    results = knowing.evaluate(run, [Step(TIME).signal(np.array([size, onset_min]))])
    assert np.nanmax(np.abs(results.w)) < 1e-3

"""The choice among models, and the flow chart."""

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import ArrayLike

from benchmarks.study_figures.flow_chart import follow
from reactorwatch.errors import InputError
from reactorwatch.identification.batch import fit_arx
from reactorwatch.identification.families import LINEAR_FAMILIES, Model
from reactorwatch.identification.linear_model import LinearModel, fit_percent
from reactorwatch.identification.selection import bic, select
from reactorwatch.identification.structure import Structure
from tests.unit.identification.truth import Array, Daisy, NoisyPlant


def test_with_measurement_noise_the_output_error_model_of_the_plants_order_is_chosen(noisy_plant: NoisyPlant) -> None:
    """Noise makes up for order in ARX models; OE of order 2 is the plant, and order 3 adds nothing."""
    selection = select(noisy_plant.inputs, noisy_plant.measured)
    assert (selection.chosen.family, selection.chosen.order) == ("oe", 2)
    assert [(c.family, c.order) for c in selection.candidates] == [(f, n) for f in ("arx", "oe") for n in (1, 2, 3)]
    assert "and BIC agrees" in selection.reason
    assert "oe of order 2" in selection.reason
    marked = [line for line in selection.table().splitlines() if line.startswith(">")]
    assert len(marked) == 1
    assert marked[0].split()[1:3] == ["oe", "2"]


def test_the_table_lists_the_fits_of_the_models_on_the_held_out_half(daisy: Daisy) -> None:
    """One row recomputed by hand: ARX 2 of T."""
    selection = select(daisy.qc, daisy.T, daisy.time, orders=(2,))
    half = 3750
    model = fit_arx(Structure.of_order(2), daisy.qc[:half], daisy.T[:half])
    run = model.simulate(daisy.qc[half:], daisy.T[half:])[:, 0]
    row = selection.candidates[0]
    assert row.free_run_percent == pytest.approx(fit_percent(daisy.T[half:], run), rel=1e-12)
    rest = daisy.T[2:half] - model.predict(daisy.qc[:half], daisy.T[:half])[2:, 0]
    assert row.bic == pytest.approx(rest.size * np.log(np.mean(rest**2)) + 5 * np.log(rest.size), rel=1e-9)


def test_of_equal_models_the_smallest_is_taken(daisy: Daisy) -> None:
    """OE 2 and 3 of the DaISy temperature differ by hundredths of a percent: two is enough."""
    selection = select(daisy.qc, daisy.T, daisy.time)
    assert (selection.chosen.family, selection.chosen.order) == ("oe", 2)
    best = max(candidate.free_run_percent for candidate in selection.candidates)
    assert selection.chosen.free_run_percent > best - 0.5


@dataclass(frozen=True)
class Persistence:
    """A family that is none of ours: tomorrow is like today."""

    name: str = "persistence"
    parameter_count: int = 0

    def fit(self, structure: Structure, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Model:
        return self

    def predict(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        y = np.asarray(outputs, dtype=np.float64)
        return np.concatenate([np.full_like(y[:1], np.nan), y[:-1]])

    def simulate(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        y = np.asarray(outputs, dtype=np.float64)
        return np.concatenate([np.full_like(y[:1], np.nan), np.repeat(y[:1], len(y) - 1, axis=0)])

    def residuals(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        return np.asarray(outputs, dtype=np.float64) - self.predict(inputs, outputs, time)


def test_another_family_joins_the_table_like_a_shipped_one(noisy_plant: NoisyPlant) -> None:
    selection = select(
        noisy_plant.inputs, noisy_plant.measured, families=(*LINEAR_FAMILIES, Persistence()), orders=(2,)
    )
    assert [candidate.family for candidate in selection.candidates] == ["arx", "oe", "persistence"]
    assert selection.candidates[-1].free_run_percent < 10.0


def test_a_model_that_cannot_be_fitted_stays_in_the_table_with_its_reason(noisy_plant: NoisyPlant) -> None:
    """A plant of first order without noise determines no third one."""
    u, y = noisy_plant.inputs, np.zeros(4000)
    for k in range(1, 4000):
        y[k] = 0.5 * y[k - 1] + u[k - 1]
    selection = select(u, y, families=LINEAR_FAMILIES[:1], orders=(1, 3))
    assert "don't determine 7 parameters" in selection.candidates[1].refusal
    assert "don't determine 7 parameters" in selection.table()
    assert selection.chosen.order == 1


def test_where_nothing_can_be_chosen_every_reason_is_given() -> None:
    with pytest.raises(InputError, match="no model can be chosen: arx 1: output 1 is constant"):
        select(np.arange(50.0), np.ones(50), families=LINEAR_FAMILIES[:1], orders=(1,))
    with pytest.raises(InputError, match="no family or order was given"):
        select(np.arange(50.0), np.ones(50), families=())
    with pytest.raises(InputError, match="order must be at least 1, got 0"):
        select(np.arange(50.0), np.arange(50.0), orders=(0,))
    with pytest.raises(InputError, match="equally many rows, got 50 and 49"):
        select(np.arange(50.0), np.arange(49.0))


def second_order(u: Array, gain: Array) -> Array:
    """A plant whose gain may change on its way, and which forgets in some ten rows."""
    y = np.zeros(u.size)
    for k in range(2, u.size):
        y[k] = 1.5 * y[k - 1] - 0.56 * y[k - 2] + 0.06 * gain[k] * u[k - 1]
    return y


LATER = np.arange(4000) >= 2000
DIFFERENT_HALVES: dict[str, tuple[Callable[[Array], Array], Callable[[Array], Array], str]] = {
    "an offset": (lambda u: u, lambda y: y + 9.0 * LATER, "the halves differ: .* by .* sd"),
    "a sensor with the wrong sign": (lambda u: u, lambda y: np.where(LATER, -y, y), "the halves differ"),
    "a gain ten times as large": (lambda u: u, lambda y: np.where(LATER, 10.0 * y, y), "the halves differ"),
    "a drift": (lambda u: u, lambda y: y + 0.02 * np.arange(4000) * LATER, "the output's mean went from"),
    "an unseen range": (lambda u: u + 50.0 * LATER, lambda y: np.minimum(y, 3.0), "out of the range of the first"),
    "noise": (lambda u: u, lambda y: 1e-3 * y + np.random.default_rng(2).standard_normal(4000), "noise"),
}


@pytest.mark.parametrize("case", DIFFERENT_HALVES)
def test_where_no_model_fits_it_recommends_none_and_reports_the_reason(case: str) -> None:
    moved, seen, why = DIFFERENT_HALVES[case]
    u = moved(np.repeat(np.random.default_rng(1).standard_normal(400), 10))
    y = seen(second_order(u, np.ones(4000))) + 0.01 * np.random.default_rng(3).standard_normal(4000)
    selection = select(u, y, families=LINEAR_FAMILIES[:1])
    assert not selection.fits
    assert max(candidate.free_run_percent for candidate in selection.candidates) < 20.0
    assert re.match(
        rf"no model fits: arx of order \d runs best on the held-out half, with -?\d.*{why}", selection.reason
    )
    assert not any(line.startswith(">") for line in selection.table().splitlines())


def test_a_model_that_fits_is_still_recommended_where_the_halves_differ_a_little(noisy_plant: NoisyPlant) -> None:
    y = noisy_plant.measured + 0.3 * (np.arange(noisy_plant.measured.size) > 2000)
    selection = select(noisy_plant.inputs, y)
    assert selection.fits
    assert "no model fits" not in selection.reason


def test_bic_is_schwarzs() -> None:
    residuals = np.array([1.0, -2.0, np.nan, 2.0])
    assert bic(residuals, 4) == pytest.approx(3.0 * np.log(9.0 / 3.0) + 4.0 * np.log(3.0))
    assert bic(np.zeros(3), 1) == -np.inf


def test_models_know_what_they_are() -> None:
    assert [family.name for family in LINEAR_FAMILIES] == ["arx", "oe"]
    plant_rows = np.random.default_rng(1).standard_normal((200, 2))
    for family in LINEAR_FAMILIES:
        model = family.fit(Structure.of_order(1), plant_rows[:, 0], plant_rows[:, 1])
        assert isinstance(model, LinearModel)
        assert model.parameter_count == 3


def arx_record(rows: int = 6000, seed: int = 2) -> tuple[Array, Array]:
    """An ARX plant of order 1: every residual of its true model is white with standard deviation 0.1."""
    rng = np.random.default_rng(seed)
    u, y = np.repeat(rng.standard_normal(rows // 5), 5), np.zeros(rows)
    for k in range(1, rows):
        y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1] + 1.0 + 0.1 * rng.standard_normal()
    return u, y


def test_an_undisturbed_record_is_fault_free() -> None:
    conclusion = follow(Structure.of_order(1), *arx_record())
    assert conclusion.verdict == "fault free"
    assert [branch.answer for branch in conclusion.branches] == ["yes", "no"]
    assert conclusion.lower_limit == pytest.approx(-0.3, rel=0.05)
    assert conclusion.upper_limit == pytest.approx(0.3, rel=0.05)


def test_false_faults_are_as_rare_as_promised() -> None:
    """One in a million is asked for: of 200 undisturbed records none is called a fault."""
    assert all(follow(Structure.of_order(1), *arx_record(600, seed)).verdict == "fault free" for seed in range(200))


def test_a_changed_plant_is_a_fault() -> None:
    u, y = arx_record()
    rng = np.random.default_rng(3)
    for k in range(4000, 6000):
        y[k] = 0.8 * y[k - 1] + 0.9 * u[k - 1] + 1.0 + 0.1 * rng.standard_normal()
    conclusion = follow(Structure.of_order(1), u, y, trusted_rows=4000)
    assert conclusion.verdict == "fault"
    assert [branch.answer for branch in conclusion.branches] == ["yes", "yes", "yes"]
    assert "-log10 p" in conclusion.branches[1].why


def test_a_plant_far_from_where_the_model_has_been_is_identified_again() -> None:
    """A hundred lively but tiny moves are trusted; the input then goes a thousand times as far: no fault is claimed."""
    rng = np.random.default_rng(4)
    u, y = np.repeat(rng.standard_normal(40), 5), np.zeros(200)
    u[:100] *= 0.1
    u[100:] *= 100.0
    for k in range(1, 200):
        y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1] + 0.1 * rng.standard_normal()
    conclusion = follow(Structure.of_order(1), u, y, trusted_rows=100)
    assert conclusion.verdict == "identify again"
    assert conclusion.branches[-1].answer == "no"


def test_a_plant_sampled_too_fast_is_to_be_sampled_again() -> None:
    rng = np.random.default_rng(5)
    u, y = np.repeat(rng.standard_normal(20), 300), np.zeros(6000)
    for k in range(1, 6000):
        y[k] = 0.99 * y[k - 1] + 0.01 * u[k - 1]
    conclusion = follow(Structure.of_order(1), u, y + 1e-3 * rng.standard_normal(6000))
    assert conclusion.verdict == "sample again"
    assert "too fast" in conclusion.branches[0].why
    assert conclusion.model is None


def test_the_chart_refuses_what_it_cannot_begin_with() -> None:
    u, y = arx_record(600)
    with pytest.raises(InputError, match="trusted_rows must be between 1 and 599, got 600"):
        follow(Structure.of_order(1), u, y, trusted_rows=600)
    with pytest.raises(InputError, match="a constant input excites none"):
        follow(Structure.of_order(1), np.ones(600), y)
    with pytest.raises(InputError, match="none of the 300 rows after the trusted ones can be predicted"):
        follow(Structure.of_order(1), u, np.where(np.arange(600) < 300, y, np.nan))

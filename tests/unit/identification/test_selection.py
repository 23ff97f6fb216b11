"""The choice among models."""

import re
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import ArrayLike

from reactorwatch.errors import InputError
from reactorwatch.identification.linear import fit_linear
from reactorwatch.identification.linear_model import fit_percent
from reactorwatch.identification.selection import LINEAR_FITS, bic, select
from reactorwatch.identification.structure import Structure
from tests.unit.identification.truth import Array, Daisy, NoisyPlant

ARX = {"arx": LINEAR_FITS["arx"]}


def test_with_measurement_noise_the_output_error_model_of_the_plants_order_is_chosen(noisy_plant: NoisyPlant) -> None:
    """Noise makes up for order in ARX models; OE of order 2 is the plant, and order 3 gains under half a percent."""
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
    model = fit_linear("arx", Structure.of_order(2), daisy.qc[:half], daisy.T[:half])
    run = model.simulate(daisy.qc[half:], daisy.T[half:])[:, 0]
    row = selection.candidates[0]
    assert row.free_run_percent == pytest.approx(fit_percent(daisy.T[half:], run), rel=1e-12)
    rest = daisy.T[2:half] - model.predict(daisy.qc[:half], daisy.T[:half])[2:, 0]
    assert row.bic == pytest.approx(rest.size * np.log(np.mean(rest**2)) + 5 * np.log(rest.size), rel=1e-9)


class Persistence:
    """A family of another kind: tomorrow is like today."""

    parameter_count = 0

    def predict(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        y = np.asarray(outputs, dtype=float)
        return np.concatenate([np.full_like(y[:1], np.nan), y[:-1]])

    def simulate(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        y = np.asarray(outputs, dtype=float)
        return np.concatenate([np.full_like(y[:1], np.nan), np.repeat(y[:1], len(y) - 1, axis=0)])

    def residuals(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        return np.asarray(outputs, dtype=float) - self.predict(inputs, outputs, time)


def test_another_family_joins_the_table_like_a_shipped_one(noisy_plant: NoisyPlant) -> None:
    selection = select(
        noisy_plant.inputs,
        noisy_plant.measured,
        fits={**LINEAR_FITS, "persistence": lambda *_: Persistence()},
        orders=(2,),
    )
    assert [candidate.family for candidate in selection.candidates] == ["arx", "oe", "persistence"]
    assert selection.candidates[-1].free_run_percent < 10.0


def test_a_model_that_cannot_be_fitted_stays_in_the_table_with_its_reason(noisy_plant: NoisyPlant) -> None:
    """A plant of first order without noise determines no third one."""
    u, y = noisy_plant.inputs, np.zeros(4000)
    for k in range(1, 4000):
        y[k] = 0.5 * y[k - 1] + u[k - 1]
    selection = select(u, y, fits=ARX, orders=(1, 3))
    assert "don't determine 7 parameters" in selection.candidates[1].refusal
    assert "don't determine 7 parameters" in selection.table()
    assert selection.chosen.order == 1


def test_where_nothing_can_be_chosen_every_reason_is_given() -> None:
    with pytest.raises(InputError, match="no model can be chosen: arx 1: output 1 is constant"):
        select(np.arange(50.0), np.ones(50), fits=ARX, orders=(1,))
    with pytest.raises(InputError, match="no family or order was given"):
        select(np.arange(50.0), np.ones(50), fits={})
    with pytest.raises(InputError, match="order must be at least 1, got 0"):
        select(np.arange(50.0), np.arange(50.0), orders=(0,))
    with pytest.raises(InputError, match="equally many rows, got 50 and 49"):
        select(np.arange(50.0), np.arange(49.0))


def second_order(u: Array) -> Array:
    """A plant that forgets in some ten rows."""
    y = np.zeros(u.size)
    for k in range(2, u.size):
        y[k] = 1.5 * y[k - 1] - 0.56 * y[k - 2] + 0.06 * u[k - 1]
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
    y = seen(second_order(u)) + 0.01 * np.random.default_rng(3).standard_normal(4000)
    selection = select(u, y, fits=ARX)
    assert not selection.fits
    assert max(candidate.free_run_percent for candidate in selection.candidates) < 20.0
    assert re.match(
        rf"no model fits: arx of order \d runs best on the held-out half, with -?\d.*{why}", selection.reason
    )
    assert not any(line.startswith(">") for line in selection.table().splitlines())


def closed_loop(pole: float) -> tuple[Array, Array]:
    """Input and output of y[k] = pole y[k-1] + 0.5 u[k-1] + e[k] under a controller with moving setpoint."""
    rng = np.random.default_rng(4)
    setpoint, e = np.repeat(rng.standard_normal(100), 20), 0.05 * rng.standard_normal((2, 2000))
    u, y = np.zeros(2000), np.zeros(2000)
    for k in range(1, 2000):
        y[k] = pole * y[k - 1] + 0.5 * u[k - 1] + e[0, k]
        u[k] = 2.0 * (pole - 0.6) * (setpoint[k] - y[k]) + e[1, k]
    return u, y


@pytest.mark.parametrize(("pole", "is_unstable"), [(0.97, False), (1.0, False), (1.02, True), (1.2, True)])
def test_a_plant_that_only_a_closed_loop_holds_is_named_unstable(pole: float, is_unstable: bool) -> None:
    selection = select(*closed_loop(pole))
    assert ("the plant is unstable" in selection.reason) is is_unstable
    if is_unstable:
        named = re.search(r"arx of order 1 has a pole at ([\d.]+) .* outside the unit circle", selection.reason)
        assert named is not None
        assert float(named[1]) == pytest.approx(pole, abs=0.005)
        assert "diverges" in selection.table()
        assert not selection.fits


def test_delays_are_compared_beside_orders(noisy_plant: NoisyPlant) -> None:
    later = np.concatenate([np.zeros(9), noisy_plant.measured[:-9]])
    selection = select(noisy_plant.inputs, later, delays=(1, 10))
    assert selection.chosen.delay == 10
    assert "oe of order 2 (delay 10)" in selection.reason
    assert "delay" in selection.table().splitlines()[0]


def test_a_model_that_fits_is_still_recommended_where_the_halves_differ_a_little(noisy_plant: NoisyPlant) -> None:
    y = noisy_plant.measured + 0.3 * (np.arange(noisy_plant.measured.size) > 2000)
    selection = select(noisy_plant.inputs, y)
    assert selection.fits
    assert "no model fits" not in selection.reason


def test_bic_is_schwarzs() -> None:
    residuals = np.array([1.0, -2.0, np.nan, 2.0])
    assert bic(residuals, 4) == pytest.approx(3.0 * np.log(9.0 / 3.0) + 4.0 * np.log(3.0))
    assert bic(np.zeros(3), 1) == -np.inf

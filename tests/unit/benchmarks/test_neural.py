"""The neural predictor, in the same table."""

import numpy as np
import pytest

from benchmarks.study_figures.neural import Neural
from reactorwatch.identification.linear_model import fit_percent
from reactorwatch.identification.selection import LINEAR_FITS, select
from reactorwatch.identification.structure import Structure
from tests.unit.identification.truth import Array, oscillating_plant

SMALL = Neural(neurons=6, seeds=(1,), iterations=100)


def bent_plant(rows: int = 1500) -> tuple[Array, Array]:
    """A plant that is linear but for a bend: y[k] = 0.7 y[k-1] + tanh(2 u[k-1])."""
    rng = np.random.default_rng(1)
    u, y = np.repeat(rng.uniform(-1.0, 1.0, rows // 3), 3), np.zeros(rows)
    for k in range(1, rows):
        y[k] = 0.7 * y[k - 1] + np.tanh(2.0 * u[k - 1])
    return u, 440.0 + y


def test_a_bent_plant_is_followed_where_no_linear_model_can() -> None:
    selection = select(*bent_plant(), fits={**LINEAR_FITS, "neural": SMALL.fit}, orders=(1,))
    linear = max(c.free_run_percent for c in selection.candidates if c.family != "neural")
    assert selection.chosen.family == "neural"
    assert linear < 85.0
    assert selection.chosen.free_run_percent > 97.0


def test_a_linear_plant_stays_linear() -> None:
    """The network has nothing to add: its one-step fit is that of the ARX model it corrects, within a percent."""
    noisy_plant = oscillating_plant()
    u, y = noisy_plant.inputs, noisy_plant.clean + 0.05 * np.random.default_rng(2).standard_normal(4000)
    model = SMALL.fit(Structure.of_order(2), u[:2000], y[:2000])
    both = [fit_percent(y[2000:], m.predict(u[2000:], y[2000:])[:, 0]) for m in (model, model.linear)]
    assert both[0] == pytest.approx(both[1], abs=1.0)


def test_the_same_seed_gives_the_same_network_and_its_run_is_its_recursion() -> None:
    u, y = bent_plant(300)
    model, again = SMALL.fit(Structure.of_order(2), u, y), SMALL.fit(Structure.of_order(2), u, y)
    np.testing.assert_array_equal(model.hidden, again.hidden)
    assert model.parameter_count == 5 + 4 * 6 + 6 + 6 + 1
    own = y.copy()
    for k in range(2, 20):
        own[k] = model.predict(u[: k + 1], own[: k + 1])[k, 0]
    np.testing.assert_allclose(model.simulate(u, y)[2:20, 0], own[2:20], rtol=1e-12)
    assert np.all(np.isnan(model.simulate(u, y)[:2]))

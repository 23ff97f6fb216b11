"""Balances of mass and energy hold for any input, and results do not depend on the choice of times."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from reactorwatch.process.library.cstr import OPERATING_STATE, cstr
from reactorwatch.process.simulate import Simulator

SIMULATOR = Simulator(cstr())
CF, TF = 1.0, 350.0  # mol/l; K, of the coolant too
ADIABATIC_RISE = 1.44e13 / 7.2e10  # K l/mol: K1/k0, what the reaction of 1 mol/l heats by

any_flows = st.lists(st.floats(0.0, 500.0), min_size=2, max_size=30)
operating_flows = st.lists(st.floats(90.0, 111.0), min_size=2, max_size=30)


@settings(max_examples=60)
@given(any_flows, st.floats(0.0, 1.5), st.floats(350.0, 560.0))
def test_any_input_keeps_within_the_bounds_of_mass_and_energy(flows: list[float], C0: float, T0: float) -> None:
    """C: nothing makes A. T: not below feed and coolant; and Z = T + (K1/k0) C is not changed by the reaction.

    dZ/dt = q/V (Tf + (K1/k0) Cf - Z) + cooling (Tcf - T), so that Z falls where it is above the feed's.
    """
    levels = np.repeat(flows, 5)
    run = SIMULATOR.run(np.arange(levels.size, dtype=np.float64) * 0.1, levels, np.array([C0, T0]))
    C, T = run.states.T
    assert np.all(np.isfinite(run.states))
    assert C.min() >= -1e-6
    assert C.max() <= max(CF, C0) + 1e-6
    assert T.min() >= TF - 1e-3
    assert (T + ADIABATIC_RISE * C).max() <= max(T0 + ADIABATIC_RISE * C0, TF + ADIABATIC_RISE * CF) + 1e-3


@settings(max_examples=40)
@given(operating_flows, st.lists(st.floats(0.0, 1.0), min_size=1, max_size=40))
def test_more_rows_in_between_change_nothing(flows: list[float], shares: list[float]) -> None:
    """A row put between two others, with the same input, is only another place to look."""
    levels = np.repeat(flows, 3)
    times = np.arange(levels.size, dtype=np.float64) * 0.1
    finer = np.unique(np.concatenate([times, times[-1] * np.array(shares)]))
    coarse = SIMULATOR.run(times, levels, np.array(OPERATING_STATE)).states
    held = levels[np.searchsorted(times, finer, side="right") - 1]
    fine = SIMULATOR.run(finer, held, np.array(OPERATING_STATE)).states[np.searchsorted(finer, times)]
    assert np.all(np.abs(fine - coarse) <= np.array([1e-6, 1e-3]))

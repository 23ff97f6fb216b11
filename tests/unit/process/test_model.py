"""The process model as a structure, and functions on arrays."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from reactorwatch.codegen.compiled_function import ArrayFunction
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.model import parameter


def test_changed_values_leave_the_original_as_it_was() -> None:
    model = cstr()
    changed = model.with_values({"V": 120.0})
    assert (changed.parameter("V").value, model.parameter("V").value) == (120.0, 100.0)
    np.testing.assert_array_equal(model.values({"V": 120.0}), changed.values())


def test_values_outside_their_bounds_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^q must be in \[1, 1000\], got 0$"):
        cstr().with_values({"q": 0.0})
    with pytest.raises(ValueError, match=r"^q must be in \[1, 1000\], got nan$"):
        cstr().with_values({"q": np.nan})
    with pytest.raises(ValueError, match=r"^x must be in \[0, 1\], got 2$"):
        parameter("x", 2.0, "1", (0.0, 1.0), "nothing")


def test_names_must_differ() -> None:
    model = cstr()
    with pytest.raises(ValueError, match="names in a model must differ, got q more than once"):
        replace(model, parameters=(*model.parameters, parameter("q", 1.0, "1", (0.0, 1.0), "another")))


def test_every_state_needs_a_balance() -> None:
    model = cstr()
    with pytest.raises(ValueError, match="rhs must have one expression a state, 2, got 1"):
        replace(model, rhs=model.rhs[:1])


def test_array_function_equals_the_function_it_is_made_of() -> None:
    """Matrices lie column by column, and structural zeros of a result are there."""
    x, A = ca.SX.sym("x", 3), ca.SX.sym("A", 2, 3)
    function = ca.Function("f", [x, A], [ca.mtimes(A, x), ca.vertcat(ca.SX(1, 1), x[0])])
    on_arrays = ArrayFunction(function)
    rng = np.random.default_rng(7)
    vector, matrix = rng.normal(size=3), rng.normal(size=(2, 3))
    on_arrays.arguments[0][0], on_arrays.arguments[1][:] = vector, matrix.T
    on_arrays()
    np.testing.assert_allclose(on_arrays.results[0][0], matrix @ vector, rtol=1e-14)
    np.testing.assert_array_equal(on_arrays.results[1][0], [0.0, vector[0]])

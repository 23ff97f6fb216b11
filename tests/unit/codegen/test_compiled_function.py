"""Machine code of a function equals CasADi's own result, to the last bit."""

import casadi as ca
import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import CompiledFunction
from reactorwatch.codegen.numba_kernel import call_at, jit

VALUES = np.array([0.5, -1.2, 0.0, -0.0, 3.0, 1e-300, 1e300, 0.9999, -7.25, np.nan, np.inf, -np.inf])


def operations() -> ca.Function:
    """(x, [a, b]) -> everything that may stand in a model."""
    x, p = ca.SX.sym("x"), ca.SX.sym("p", 2)
    a, b = p[0], p[1]
    one = [ca.exp, ca.log, ca.sqrt, ca.sin, ca.cos, ca.tan, ca.asin, ca.acos, ca.atan, ca.sinh, ca.cosh, ca.tanh]
    one += [ca.asinh, ca.acosh, ca.atanh, ca.erf, ca.log1p, ca.expm1, ca.floor, ca.ceil, ca.fabs, ca.sign]
    two = [ca.fmin, ca.fmax, ca.fmod, ca.atan2, ca.copysign, ca.hypot, ca.logic_and, ca.logic_or]
    told = [f(x) for f in one] + [f(x, a) for f in two] + [f(b, x) for f in two]
    told += [x + a, x - b, x * a, x / b, x**a, x**1.7, x**2, 2 * x, 1 / x, -x, ca.logic_not(x), ca.if_else(x, a, b)]
    told += [x < a, x <= a, x == a, x != a, ca.if_else(x > b, x, a)]
    return ca.Function("operations", [x, p], [ca.vertcat(*told)])


def same(found: Array, expected: ca.DM) -> bool:
    return np.array_equal(found, np.array(expected), equal_nan=True)


@pytest.mark.parametrize("p", [(0.5, -2.0), (0.0, 3.0), (np.nan, np.inf)])
def test_every_operation_is_casadi_s(p: tuple[float, float]) -> None:
    function = operations()
    (found,) = CompiledFunction(function, shared=[1]).map(VALUES, np.array(p))
    for value, row in zip(VALUES, found, strict=True):
        assert same(row, function(value, p)), value


def test_matrices_keep_their_shape_and_structural_zeros_are_there() -> None:
    x, A = ca.SX.sym("x", 3), ca.SX.sym("A", 2, 3)
    function = ca.Function("f", [x, A], [ca.mtimes(x, x.T), ca.mtimes(A, x), ca.vertcat(ca.SX(1, 1), x[0])])
    rng = np.random.default_rng(7)
    xs, a = rng.normal(size=(5, 3)), rng.normal(size=(2, 3))
    found = CompiledFunction(function, shared=[1]).map(xs, a.T)
    for number, results in enumerate(zip(*found, strict=True)):
        assert all(same(*pair) for pair in zip(results, function(xs[number], a), strict=True))


def test_a_chain_goes_from_row_to_row() -> None:
    """X <- x + u, of which the sums are known."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    code = CompiledFunction(ca.Function("f", [x, u], [x + u]), chained=1)
    (sums,) = code.map(np.array([10.0]), np.arange(1.0, 6.0))
    np.testing.assert_array_equal(sums.ravel(), [11.0, 13.0, 16.0, 20.0, 25.0])


def test_a_chain_stops_with_the_row_that_does_not_go_well() -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    code = CompiledFunction(ca.Function("f", [x, u], [x + u, x + u < 15]), chained=1, stops=True)
    after, good = np.zeros(5), np.zeros(5)
    assert code.fill(5, [np.array([10.0]), np.arange(1.0, 6.0)], [after, good]) == 2
    np.testing.assert_array_equal(after, [11.0, 13.0, 16.0, 0.0, 0.0])  # the third is worked out, and no more


@jit
def _filled_at(address: int, u: Array, x: Array) -> int:
    return call_at(address, (u.size, x.ctypes.data, u.ctypes.data, x.ctypes.data))


def test_a_kernel_calls_it_by_its_address() -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    code = CompiledFunction(ca.Function("f", [x, u], [2 * x + u]), chained=1)
    row = np.array([1.0])
    assert _filled_at(code.address, np.array([3.0]), row) == 1
    np.testing.assert_array_equal(row, [5.0])


def test_what_is_no_number_does_not_go_well() -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    code = CompiledFunction(ca.Function("f", [x, u], [x + u, x + u]), chained=1, stops=True)
    assert code.fill(2, [np.array([1.0]), np.array([1.0, np.nan])], [np.zeros(2), np.zeros(2)]) == 1


def test_no_rows_have_no_results() -> None:
    x = ca.SX.sym("x")
    (found,) = CompiledFunction(ca.Function("f", [x], [x])).map(np.empty((0, 1)))
    assert found.shape == (0, 1, 1)


@pytest.mark.parametrize("wrong", [np.zeros(4), np.zeros(10)[::2], np.zeros(5, dtype=np.float32)])
def test_arrays_that_do_not_fit_are_refused(wrong: Array) -> None:
    """It would read or write what is not its own."""
    x = ca.SX.sym("x")
    code = CompiledFunction(ca.Function("f", [x], [2 * x]))
    with pytest.raises(ValueError, match="an array of 5 float64 without gaps is needed"):
        code.fill(5, [wrong], [np.zeros(5)])
    with pytest.raises(ValueError, match="an array of 5 float64 without gaps is needed"):
        code.fill(5, [np.zeros(5)], [wrong])


def test_an_operation_without_machine_code_is_named() -> None:
    x = ca.SX.sym("x")
    with pytest.raises(ValueError, match="no machine code for CasADi's operation OP_ERFINV"):
        CompiledFunction(ca.Function("f", [x], [ca.erfinv(x)])).prepare()


@pytest.mark.parametrize("rows", [1, 2, 3, 4, 5, 11, 12])
def test_every_row_is_done_whatever_the_number_of_rows(rows: int) -> None:
    """Rows are taken four at a time; behind the last one nothing is written."""
    x = ca.SX.sym("x", 2)
    code = CompiledFunction(ca.Function("f", [x], [ca.vertcat(x[0] + x[1], ca.sin(x[0]))]))
    xs, into = np.random.default_rng(rows).normal(size=(rows, 2)), np.full((rows + 4, 2), -7.0)
    assert code.fill(rows, [xs], [into]) == rows
    np.testing.assert_array_equal(into[:rows, 0], xs[:, 0] + xs[:, 1])
    assert np.all(into[rows:] == -7.0)


@pytest.mark.parametrize("chains", [1, 2, 3, 4])
def test_chains_go_together_each_by_itself(chains: int) -> None:
    """X <- a x + u of each chain, with a start, a factor and inputs of its own."""
    x, u, a = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("a")
    code = CompiledFunction(ca.Function("f", [x, u, a], [a * x + u]), shared=[2], chained=1)
    rng = np.random.default_rng(chains)
    starts, us, factors = rng.normal(size=(chains, 1)), rng.normal(size=(chains, 9)), rng.normal(size=(chains, 1))
    results = [[np.empty(9)] for _ in range(chains)]
    assert code.fill_chains(9, list(zip(starts, us, factors, strict=True)), results) == 9
    for start, inputs, factor, (found,) in zip(starts, us, factors, results, strict=True):
        value = start[0]
        for row in range(9):
            value = factor[0] * value + inputs[row]
            assert found[row] == value


def test_chains_that_go_together_stop_with_the_first_that_does_not_go_well() -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    code = CompiledFunction(ca.Function("f", [x, u], [x + u, 15 - (x + u)]), chained=1, stops=True)
    arguments = [[np.array([begin]), np.arange(1.0, 6.0)] for begin in (0.0, 7.0, -50.0)]
    results = [[np.zeros(5), np.zeros(5)] for _ in arguments]
    assert code.fill_chains(5, arguments, results) == 3  # 7 + 1 + 2 + 3 < 15, + 4 is not
    np.testing.assert_array_equal(results[2][0][:3], [-49.0, -47.0, -44.0])

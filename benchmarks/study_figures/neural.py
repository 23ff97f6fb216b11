"""A neural network as predictor: NARX, y[k] = f(y[k-1], ..., y[k-n], u[k-d], ..., u[k-d-m+1]).

f is a linear combination of the regressors plus a network with one hidden layer of tanh (Narendra and Parthasarathy,
IEEE Trans. Neural Networks 1 (1990) 4, the series-parallel model). The network learns the residual of the ARX model of
the same structure, so it need not approximate a linear function, and does no harm for a linear plant. Its weights are
found by scikit-learn's MLPRegressor (L-BFGS, an explicit seed); the prediction is computed here, because a simulation
needs one row at a time.

A network with a good one-step-ahead prediction may still diverge in simulation. Of several networks with different
initial weights the one with the best simulation of the fitted rows is chosen.
"""

import warnings
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.exceptions import ConvergenceWarning  # type: ignore[import-untyped]
from sklearn.neural_network import MLPRegressor  # type: ignore[import-untyped]

from reactorwatch.identification.data import ScaledRecord, plan_run, rows_of
from reactorwatch.identification.linear import fit_linear
from reactorwatch.identification.linear_model import LinearModel, fit_percent
from reactorwatch.identification.structure import Scaling, Structure, as_columns

_DIVERGED = 1e6  # a scaled output beyond this, a million times its spread, has diverged


@dataclass(frozen=True)
class NeuralModel:
    """A fitted network beside the linear model whose residual it learned."""

    linear: LinearModel  # the model that the network corrects
    scaling: Scaling  # scaling of the signals
    residual_sd: float  # scale of the network's output, in the output's unit
    hidden: NDArray[np.float64]  # shape (regressors, neurons), weights into the hidden layer
    hidden_bias: NDArray[np.float64]  # shape (neurons,)
    output: NDArray[np.float64]  # shape (neurons,), weights out of the hidden layer
    output_bias: float  # constant of the output

    @property
    def parameter_count(self) -> int:
        """Number of parameters, the linear model's included."""
        return self.linear.parameter_count + self.hidden.size + self.hidden_bias.size + self.output.size + 1

    def predict(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float64]:
        """See `LinearModel.predict`."""
        predicted = self.linear.predict(inputs, outputs, time)
        u, y = self.scaling.inputs(as_columns(inputs, "inputs")), self.scaling.outputs(as_columns(outputs, "outputs"))
        rows = rows_of(self.linear.structure.without_offset(), u, y, time)
        predicted[rows.position, 0] += self._correction(rows.regressors)
        return predicted

    def simulate(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float64]:
        """See `LinearModel.simulate`."""
        structure, scaling = self.linear.structure, self.scaling
        u = scaling.inputs(as_columns(inputs, "inputs", structure.inputs))
        y = scaling.outputs(as_columns(outputs, "outputs", 1))
        plan = plan_run(structure, u, y, time)
        matrix, shift = scaling.unscaling(structure)
        theta = np.linalg.solve(matrix, self.linear.parameters - shift)
        weights, constant = (theta[:-1], theta[-1]) if structure.offset else (theta, 0.0)
        spread = scaling.output_spreads[0]
        own, run = y[:, 0].copy(), np.full(y.shape, np.nan)
        first = structure.delays[0] - 1
        for k in np.flatnonzero(plan.running):
            if plan.starts[k]:
                own[k - structure.history : k] = y[k - structure.history : k, 0]
            past_outputs = own[k - structure.output_lags : k][::-1]
            past_inputs = u[k - first - structure.input_lags : k - first][::-1].ravel()
            regressor = np.concatenate([past_outputs, past_inputs])
            value = float(weights @ regressor) + constant + self._correction(regressor) / spread
            own[k] = min(max(float(value), -_DIVERGED), _DIVERGED)
            run[k] = own[k] if abs(own[k]) < _DIVERGED else np.inf
        return run * spread + scaling.output_centres[0]

    def residuals(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float64]:
        """Measured minus one-step prediction, shape (rows, 1)."""
        return as_columns(outputs, "outputs") - self.predict(inputs, outputs, time)

    def _correction(self, regressors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Output of the network in the output's unit; the last axis is that of the regressors."""
        hidden = np.tanh(regressors @ self.hidden + self.hidden_bias)
        return np.asarray((hidden @ self.output + self.output_bias) * self.residual_sd)


@dataclass(frozen=True)
class Neural:
    """The family of these models."""

    neurons: int = 12  # number of neurons in the hidden layer
    seeds: tuple[int, ...] = (1, 2, 3)  # seeds of the initial weights; one network is fitted for each
    iterations: int = 200  # largest number of iterations of each search

    def fit(
        self, structure: Structure, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None
    ) -> NeuralModel:
        """Fit the networks and choose the one with the best simulation."""
        linear = fit_linear("arx", structure, inputs, outputs, time)
        record = ScaledRecord.of(structure, inputs, outputs, time)
        # Without the constant: the network has its own.
        rows = replace(record, structure=structure.without_offset()).enough_rows()
        residuals = linear.residuals(inputs, outputs, time)[rows.position, 0]
        spread = float(np.std(residuals)) or 1.0
        models = []
        for seed in self.seeds:
            network = MLPRegressor(
                hidden_layer_sizes=(self.neurons,),
                activation="tanh",
                solver="lbfgs",
                alpha=1e-3,
                max_iter=self.iterations,
                max_fun=20 * self.iterations,
                random_state=seed,
            )
            with warnings.catch_warnings():
                # Stopping at the number of iterations is intended: more of them fit the noise.
                warnings.simplefilter("ignore", ConvergenceWarning)
                network.fit(rows.regressors, residuals / spread)
            (hidden, output), (hidden_bias, output_bias) = network.coefs_, network.intercepts_
            models.append(
                NeuralModel(linear, record.scaling, spread, hidden, hidden_bias, output[:, 0], float(output_bias[0]))
            )
        measured = as_columns(outputs, "outputs")[:, 0]
        return max(models, key=lambda model: fit_percent(measured, model.simulate(inputs, outputs, time)[:, 0]))

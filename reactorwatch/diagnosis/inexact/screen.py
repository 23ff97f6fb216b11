"""Evidence of every cause with every course in time, by the model linearised about a simulation with nuisance.

With nuisance theta ~ N(0, S^2) and a size s ~ N(0, w^2) the whitened residual r is normal, so with the columns B of
nuisance and f of a cause

    log E = -(|r|^2 + |theta_0/S|^2)/2 + |z|^2/2 - log det L + (f'r - Z_f'z)^2/2/(f'f - Z_f'Z_f + w^-2)
            - log(1 + w^2 (f'f - Z_f'Z_f))/2,    L L' = 1 + S B'B S,    L z = S B'r - theta_0/S,    L Z_f = S B'f,

in which theta_0 is the nuisance of the simulation. So only Gram matrices are needed for all causes, onsets and priors.
"""

from collections.abc import Iterator, Sequence
from math import log

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.inexact.hypotheses import (
    CONSTANT,
    CURVE,
    CURVE_COST,
    KNOTS,
    NONE,
    RAMP,
    STEP,
    WIDTH,
    Courses,
    Hypothesis,
    random_walk,
)
from reactorwatch.diagnosis.inexact.nuisance import Nuisance, Prior


class Screen:
    """Gram matrices of whitened residual, nuisance and causes.

    Args:
        nuisance: layout of the nuisance.
        courses: courses in time.
        widths: standard deviation of each nuisance that is a cause, by its index.
        theta: nuisance of the simulation, shape (size,).
        residual: whitened residual, shape (values,).
        base: whitened derivatives by the nuisance, shape (values, size).
        causes: whitened derivatives by every effect in all steps, then hats, shape (values, effects, courses).
    """

    def __init__(
        self,
        nuisance: Nuisance,
        courses: Courses,
        widths: dict[int, float],
        theta: Array,
        residual: Array,
        base: Array,
        causes: Array,
    ) -> None:
        self._nuisance, self._courses, self._widths, self._theta = nuisance, courses, widths, theta
        effects, onsets = causes.shape[1], courses.onsets.size
        hats = causes[:, :, onsets:]
        steps_and_ramps = np.concatenate([causes[:, :, :onsets], hats @ courses.ramp_weights()], axis=2)
        flat, curves = steps_and_ramps.reshape(len(residual), -1), hats.reshape(len(residual), -1)
        self._residual, self._base, self._square = residual, base, float(residual @ residual)
        self._bb, self._br = base.T @ base, base.T @ residual
        self._bf, self._bh = base.T @ flat, base.T @ curves
        self._ff, self._fr = np.einsum("ij,ij->j", flat, flat), flat.T @ residual
        self._hh = np.stack([hats[:, k].T @ hats[:, k] for k in range(effects)])
        self._hr = (curves.T @ residual).reshape(effects, KNOTS)
        self._with_nuisance = {prior: self._solve(nuisance.sds(prior)) for prior in nuisance.priors}

    def rank(self) -> list[Hypothesis]:
        """All hypotheses, the likeliest first."""
        found = (item for prior in self._nuisance.priors for item in self._with_prior(prior))
        return sorted(found, key=lambda item: -item.log_evidence)

    def refine(
        self, ranked: Sequence[Hypothesis], effect: int, onsets: Array, steps: Array, given: NDArray[np.bool_]
    ) -> list[Hypothesis]:
        """The same hypotheses, those with a step of an effect at the best of other onsets, the likeliest first.

        A sensor's step jumps: at the nearest of the onsets of all causes it may leave a pulse of many rows.

        Args:
            ranked: hypotheses by the onsets of all causes.
            effect: index of the effect.
            onsets: equally likely, shape (n,).
            steps: whitened derivatives by the steps, shape (given values, n).
            given: values on which they act, shape (values,).
        """
        ff, fr = np.einsum("ij,ij->j", steps, steps), steps.T @ self._residual[given]
        bf = self._base[given].T @ steps
        width, result = WIDTH * float(self._nuisance.simulation.typical[effect]), []
        for item in ranked:
            if item.cause == (STEP, effect):
                sds, (lower, z, none) = self._nuisance.sds(item.prior), self._with_nuisance[item.prior]
                with_base = solve_triangular(lower, sds[:, None] * bf, lower=True)
                gain, sizes = _gains(ff, fr, with_base, z, width)
                best = int(np.argmax(gain))
                evidence = none + gain[best] + log(float(np.mean(np.exp(gain - gain[best]))))
                item = item._replace(onset=float(onsets[best]), size=float(sizes[best]), log_evidence=float(evidence))
            result.append(item)
        return sorted(result, key=lambda item: -item.log_evidence)

    def _with_prior(self, prior: Prior) -> Iterator[Hypothesis]:
        sds = self._nuisance.sds(prior)
        lower, z, none = self._with_nuisance[prior]
        yield Hypothesis(NONE, -1, prior, log_evidence=none)
        for index, width in self._widths.items():
            wider = sds.copy()
            wider[index] = width
            yield Hypothesis(CONSTANT, index, prior, log_evidence=self._solve(wider)[2])
        typical, first = self._nuisance.simulation.typical, float(self._courses.time_min[0])
        onsets = self._courses.onsets
        size_sd = np.repeat(WIDTH * typical, 2 * onsets.size)
        with_base = solve_triangular(lower, sds[:, None] * self._bf, lower=True)
        gain, sizes = (item.reshape(-1, 2, onsets.size) for item in _gains(self._ff, self._fr, with_base, z, size_sd))
        for k in range(len(typical)):
            for number, kind in enumerate((STEP, RAMP)):
                best = int(np.argmax(gain[k, number]))
                most = float(gain[k, number, best])
                evidence = none + most + log(float(np.mean(np.exp(gain[k, number] - most))))
                onset, size = float(onsets[best]), float(sizes[k, number, best])
                yield Hypothesis(kind, k, prior, onset, size, evidence)
            walk, part = random_walk(float(typical[k])), slice(k * KNOTS, (k + 1) * KNOTS)
            beside = solve_triangular(lower, sds[:, None] * self._bh[:, part], lower=True)
            known = np.linalg.cholesky(np.eye(KNOTS) + walk.T @ (self._hh[k] - beside.T @ beside) @ walk)
            v = solve_triangular(known, walk.T @ (self._hr[k] - beside.T @ z), lower=True)
            evidence = none + 0.5 * float(v @ v) - float(np.sum(np.log(np.diag(known)))) - CURVE_COST
            yield Hypothesis(CURVE, k, prior, first, log_evidence=evidence)

    def _solve(self, sds: Array) -> tuple[Array, Array, float]:
        """L, z and the logarithm of the evidence without a cause."""
        lower = np.asarray(np.linalg.cholesky(np.eye(sds.size) + sds[:, None] * self._bb * sds), dtype=float)
        z: Array = solve_triangular(lower, sds * self._br - self._theta / sds, lower=True)
        centre = float(np.sum((self._theta / sds) ** 2))
        evidence = 0.5 * (float(z @ z) - self._square - centre) - float(np.sum(np.log(np.diag(lower))))
        return lower, z, evidence


def _gains(ff: Array, fr: Array, with_base: Array, z: Array, size_sd: Array | float) -> tuple[Array, Array]:
    """Gain of log evidence by each column of a cause, and its size, both of shape (columns,)."""
    precision = np.maximum(ff - np.einsum("ij,ij->j", with_base, with_base), 0.0)
    score, known = fr - with_base.T @ z, precision + np.square(1.0 / np.asarray(size_sd))
    return 0.5 * score**2 / known - 0.5 * np.log1p(np.square(size_sd) * precision), score / known

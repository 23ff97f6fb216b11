"""For each chart of the catalogue: one to try, what to feed it, and the run length it should have."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reactorwatch.spc.charts.cusum import Cusum, cusum_run_length
from reactorwatch.spc.charts.cva_residual import CvaResidual
from reactorwatch.spc.charts.edetector import EDetector
from reactorwatch.spc.charts.ewma import Ewma, ewma_run_length
from reactorwatch.spc.charts.level import Level
from reactorwatch.spc.charts.mewma import Mewma, mewma_run_length
from reactorwatch.spc.charts.multiple_pca import MultiplePca
from reactorwatch.spc.charts.multiway_pca import STAGES, MultiwayPca
from reactorwatch.spc.charts.parameters import ParameterT2
from reactorwatch.spc.charts.pca import PcaModel, PcaSpe, PcaT2
from reactorwatch.spc.charts.pls import Pls
from reactorwatch.spc.charts.residual_space import ResidualSpace
from reactorwatch.spc.charts.shewhart import Shewhart, shewhart_run_length
from reactorwatch.spc.charts.t2 import T2, t2_run_length
from reactorwatch.spc.compiled_chart import OUT, PRESENT, CompiledChart, SignalMemory, X, columns_of, restart_columns

Array = NDArray[np.float64]

MEAN, SIGMA = 438.5, 0.3
MEANS = np.array([438.5, 0.1, 103.4])
COVARIANCE = np.array([[0.09, 0.001, 0.0], [0.001, 0.0001, 0.002], [0.0, 0.002, 1.0]])
ROOT = np.linalg.cholesky(COVARIANCE)
SHIFT = 1.0


class Plants:
    """Charts of one kind, one a plant, updated by their kernel in one call."""

    def __init__(self, charts: Sequence[CompiledChart]) -> None:
        self.kind = type(charts[0])
        self.memory = SignalMemory(self.kind.name, np.concatenate([item.memory.numbers for item in charts], axis=1))
        self.columns = columns_of(self.kind, self.memory)

    def update(self, x: Array, present: NDArray[np.bool_] | bool = True) -> NDArray[np.bool_]:
        """Next value of every plant that is present; True where its chart is out."""
        self.columns[X], self.columns[PRESENT] = x, present
        self.kind.kernel(self.columns)
        return np.asarray(present & (self.columns[OUT] > 0.0))

    def restart(self, plants: NDArray[np.bool_]) -> None:
        """Forget the values of the plants that are True."""
        restart_columns(self.columns, self.kind.memories, plants)


@dataclass(frozen=True)
class Member:
    """One chart of the catalogue.

    Attributes:
        new: a chart.
        sample: shape (rows, ...) of shifted samples.
        run_length: the mean number of samples to the signal.
    """

    new: Callable[[], Any]
    sample: Callable[[np.random.Generator, int], Array]
    run_length: float


def value(rng: np.random.Generator, rows: int) -> Array:
    return MEAN + SIGMA * (rng.standard_normal(rows) - SHIFT)


def vector(rng: np.random.Generator, rows: int) -> Array:
    white = rng.standard_normal((rows, 3))
    white[:, 0] += SHIFT
    return MEANS + white @ ROOT.T


def difference(rng: np.random.Generator, rows: int) -> Array:
    return np.asarray(vector(rng, rows) - MEANS)


def related(rng: np.random.Generator, rows: int) -> Array:
    """Six signals driven by two, with noise of its own in each: the eigenvalues left out are equal."""
    driving = np.array([[1.0, 1.0, 1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]])
    return np.asarray(rng.standard_normal((rows, 2)) @ driving + 0.5 * rng.standard_normal((rows, 6)))


MODEL = PcaModel.fit(related(np.random.default_rng(1), 20_000), components=2, false_alarm=0.05)

SIZES, AXES = np.linalg.eigh(COVARIANCE)
"""Variances and directions of the principal components of `vector`."""


def known(statistics: int) -> dict[str, Array]:
    """Averages of cube roots that are shown as they are, of three signals."""
    one = np.ones(statistics)
    return {"root_means": 0.0 * one, "root_sds": one, "average_sds": one, "usual_parts": np.zeros((statistics, 3))}


NEWEST = np.hstack([np.zeros((3, 6)), np.linalg.inv(ROOT)])
"""Relations of the newest of three rows: Tr2 is a third of its T2."""

MEMBERS: dict[type, Member] = {
    Shewhart: Member(
        lambda: Shewhart(MEAN, SIGMA, rules=(1, 2, 3, 4)), value, shewhart_run_length(SHIFT, rules=(1, 2, 3, 4))
    ),
    Cusum: Member(lambda: Cusum(MEAN, SIGMA, 0.5, 4.0, 2.0), value, cusum_run_length(SHIFT, 0.5, 4.0, 2.0)),
    EDetector: Member(  # by 200,000 runs of the recursion in numpy, to 0.02
        lambda: EDetector(MEAN, SIGMA, 100.0), value, 16.076
    ),
    Ewma: Member(
        lambda: Ewma(MEAN, SIGMA, 0.1, 2.8, exact_limits=True),
        value,
        ewma_run_length(SHIFT, 0.1, 2.8, exact_limits=True),
    ),
    Level: Member(  # of one output, as an average alone
        lambda: Level(["T"], [MEAN], [SIGMA * sqrt(0.1 / 1.9)], weight=0.1, limit=2.8),
        lambda rng, rows: value(rng, rows)[:, None],
        ewma_run_length(SHIFT, 0.1, 2.8),
    ),
    T2: Member(lambda: T2(MEANS, COVARIANCE, 10.0), vector, t2_run_length(SHIFT, 3, 10.0)),
    Mewma: Member(lambda: Mewma(MEANS, COVARIANCE, 0.2, 11.0), vector, mewma_run_length(SHIFT, 3, 0.2, 11.0)),
    ParameterT2: Member(
        lambda: ParameterT2(["a1", "b1", "c"], np.linalg.inv(ROOT), 10.0, np.eye(3)[1:]),
        difference,
        t2_run_length(SHIFT, 3, 10.0),
    ),
    PcaT2: Member(lambda: PcaT2(MODEL), related, 20.0),
    PcaSpe: Member(lambda: PcaSpe(MODEL), related, 20.0),
    CvaResidual: Member(  # without memory, whose first two rows are not judged
        lambda: CvaResidual(
            ["C", "T", "qc"],
            {"centre": MEANS, "scale": np.ones(3), "rest": NEWEST, **known(1)},
            weight=1.0,
            limit=float(np.cbrt(10.0 / 3.0)),
        ),
        vector,
        t2_run_length(SHIFT, 3, 10.0) + 2.0,
    ),
    Pls: Member(  # all three signals are white scores, so nothing is left for SPE
        lambda: Pls(
            ["C", "T", "qc"],
            {
                "centre": MEANS,
                "scale": np.ones(3),
                "is_quality": np.zeros(3),
                "rotations": np.linalg.inv(ROOT).T,
                "loadings": ROOT,
                "of_quality": np.zeros((0, 3)),
                "variances": np.ones(3),
                "rest": np.ones(1),
                **known(2),
            },
            weight=1.0,
            limit=float(np.cbrt(10.0 / 3.0)),
        ),
        vector,
        t2_run_length(SHIFT, 3, 10.0),
    ),
    MultiplePca: Member(  # of one regime
        lambda: MultiplePca(
            ["C", "T", "qc"],
            {
                "centre": MEANS,
                "scale": np.ones(3),
                "plane": np.eye(3),
                "shares": np.ones(1),
                "means": np.zeros((1, 3)),
                "roots": np.eye(3)[None],
                "centres": np.zeros((1, 3)),
                "loadings": AXES[None],
                "variances": SIZES[None],
                "rests": np.array([[1e3]]),
                **known(2),
            },
            weight=1.0,
            limit=float(np.cbrt(10.0 / 3.0)),
        ),
        vector,
        t2_run_length(SHIFT, 3, 10.0),
    ),
    MultiwayPca: Member(  # whose course is level
        lambda: MultiwayPca(
            ["time", "C", "T", "qc"],
            {
                "is_progress": np.array([1.0, 0.0, 0.0, 0.0]),
                "nodes": np.linspace(0.0, 1.0, STAGES + 1),
                "courses": np.tile(MEANS, (STAGES + 1, 1)),
                "course_sds": np.ones((STAGES + 1, 3)),
                "rotations": AXES,
                "loadings": AXES,
                "variances": SIZES,
                "rest": np.array([1e3]),
                **known(2),
                "usual_parts": np.zeros((2, 4)),
            },
            weight=1.0,
            limit=float(np.cbrt(10.0 / 3.0)),
        ),
        lambda rng, rows: np.column_stack([rng.random(rows), vector(rng, rows)]),
        t2_run_length(SHIFT, 3, 10.0),
    ),
    ResidualSpace: Member(  # of one signal, whose average it is
        lambda: ResidualSpace(["T"], [MEAN], [[sqrt(1.9 / 0.1) / SIGMA]], weight=0.1, limit=2.8),
        lambda rng, rows: value(rng, rows)[:, None],
        ewma_run_length(SHIFT, 0.1, 2.8),
    ),
}

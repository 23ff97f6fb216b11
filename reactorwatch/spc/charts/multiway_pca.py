"""Multiway PCA of batches: principal components of the deviations from the mean course of a batch.

Nomikos & MacGregor (1994), Monitoring batch processes using multiway principal component analysis, AIChE J. 40;
unfolded by variables: Wold, Kettaneh, Friden & Holmberg (1998), Modelling and diagnostics of batch processes,
Chemometrics Intell. Lab. Syst. 44. The course of each signal has a mean and a standard deviation at every stage of a
batch. Stages are measured by a signal that rises in each batch, such as its time or the amount that was fed: an
indicator variable, by which batches of unequal duration are aligned (Kourti 2003, Abnormal situation detection,
three-way data and projection methods, Ann. Rev. Control 27). A row of a batch in progress is then complete, and T2 and
SPE of its deviations are charted row by row. Blocks that are held out are of whole batches.
"""

import numpy as np

from reactorwatch.arrays import BLOCKS, Array
from reactorwatch.spc.charts.base import Setting, SignalSetting
from reactorwatch.spc.charts.pca import Components
from reactorwatch.spc.charts.value_chart import Model, StatisticsChart, ValueBaseline

STAGES = 20
"""Number of intervals of a batch; courses are linear within one."""


class MultiwayPca(StatisticsChart):
    """T2 and SPE of the deviations from the mean course of a batch."""

    name = "multiway_pca"
    settings = (Setting("multiway_pca_weight", 0.1, 0.01, 1.0), SignalSetting("multiway_pca_progress", 1))
    labels = ("T2", "SPE")
    weight_key = "multiway_pca_weight"
    reason = "at this stage of a batch is unlike that of earlier batches"
    fewest_signals = 3
    is_skewed = True

    @classmethod
    def obstacle(cls, baseline: ValueBaseline) -> str:
        """See `ValueChart`."""
        if why := super().obstacle(baseline):
            return why
        count, needed = len(batch_starts(progress_of(baseline))), 2 * BLOCKS
        few = f"the training has {count} batches, {needed} are needed (the progress falls between batches)"
        return few if count < needed else ""

    @classmethod
    def edges(cls, baseline: ValueBaseline) -> list[int]:
        """See `StatisticsChart`; batches stay whole."""
        starts = batch_starts(progress_of(baseline))
        chosen = np.linspace(0, len(starts), BLOCKS + 1).astype(int)[1:-1]
        return [0, *(starts[index] for index in chosen.tolist()), len(baseline.values)]

    @classmethod
    def most_freedom(cls, baseline: ValueBaseline) -> float:
        """See `StatisticsChart`; a batch is unlike others as a whole, so the batches are what is independent."""
        return len(batch_starts(progress_of(baseline))) - 1.0

    @classmethod
    def fit(cls, values: Array, baseline: ValueBaseline) -> Model:
        """See `StatisticsChart`."""
        is_progress = np.array([name in baseline.signals["multiway_pca_progress"] for name in baseline.names])
        progress, x = values[:, is_progress][:, 0], values[:, ~is_progress]
        nodes = np.linspace(progress.min(), progress.max(), STAGES + 1)
        basis = np.array([np.interp(progress, nodes, row) for row in np.eye(nodes.size)]).T
        means = smooth_courses(basis, x)
        total = x.std(axis=0, ddof=1)
        squares = smooth_courses(basis, (x - basis @ means) ** 2)
        # A stage has at least a tenth of the standard deviation of the whole batch.
        sds = np.sqrt(np.maximum(squares, (0.1 * np.where(total > 0.0, total, 1.0)) ** 2))
        z = (x - basis @ means) / (basis @ sds)
        courses = {"is_progress": is_progress.astype(np.float64), "nodes": nodes, "courses": means, "course_sds": sds}
        return courses | Components.principal(z.T @ z / len(z))._asdict()

    @classmethod
    def parts(cls, model: Model, window: Array) -> Array:
        """See `StatisticsChart`; the progress has none."""
        is_progress, nodes = model["is_progress"] > 0.0, model["nodes"]
        stage = float(np.clip((window[-1][is_progress][0] - nodes[0]) / (nodes[1] - nodes[0]), 0.0, STAGES))
        first = min(int(stage), STAGES - 1)
        share = stage - first
        mean, sd = (
            (1.0 - share) * item[first] + share * item[first + 1] for item in (model["courses"], model["course_sds"])
        )
        z = (window[-1][~is_progress] - mean) / sd
        parts = np.zeros((2, is_progress.size))
        parts[:, ~is_progress] = Components.of(model).relative_parts(z)
        return parts

    def fill(self, x: Array) -> Array | None:
        """See `ValueChart`; a row without the progress is skipped."""
        return super().fill(x) if np.isfinite(x[self.model["is_progress"] > 0.0]).all() else None


def progress_of(baseline: ValueBaseline) -> Array:
    """Values of the signal that measures the progress of a batch."""
    return baseline.values[:, baseline.names.index(baseline.signals["multiway_pca_progress"][0])]


def batch_starts(progress: Array) -> list[int]:
    """First row of each batch."""
    falls = np.flatnonzero(np.diff(progress) < -0.5 * np.ptp(progress)) + 1  # a fall by half its range begins a batch
    starts: list[int] = [0, *falls.tolist()]
    return starts


def smooth_courses(basis: Array, values: Array) -> Array:
    """Values at the stages, by least squares, shape (stages + 1, signals).

    Args:
        basis: weight of each stage in a row, shape (rows, stages + 1).
        values: values of the signals, shape (rows, signals).
    """
    gram = basis.T @ basis
    gram[np.diag_indices_from(gram)] += 1e-9 * len(basis)
    return np.asarray(np.linalg.solve(gram, basis.T @ values))

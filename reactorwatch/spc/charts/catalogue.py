"""The catalogue of control charts. A new one: a file here, and a line below.

From it come the names that `[monitor] charts` takes, the charts' own keys there, and their alarms.
"""

from collections.abc import Iterable

from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import Chart, Design
from reactorwatch.spc.charts.cusum import Cusum
from reactorwatch.spc.charts.cva_residual import CvaResidual
from reactorwatch.spc.charts.ewma import Ewma
from reactorwatch.spc.charts.mewma import MOST_SHIFTED_SIGNALS, Mewma
from reactorwatch.spc.charts.multiple_pca import MultiplePca
from reactorwatch.spc.charts.multiway_pca import MultiwayPca
from reactorwatch.spc.charts.parameters import ParameterT2
from reactorwatch.spc.charts.pca import PcaSpe, PcaT2
from reactorwatch.spc.charts.pls import Pls
from reactorwatch.spc.charts.residual_space import ResidualSpace
from reactorwatch.spc.charts.shewhart import Shewhart, checked_rules
from reactorwatch.spc.charts.t2 import T2
from reactorwatch.spc.run_length import LONGEST_DESIGN, SHORTEST_DESIGN, check_range

CHARTS: tuple[type[Chart], ...] = (
    Shewhart,
    Ewma,
    Cusum,
    T2,
    Mewma,
    PcaT2,
    PcaSpe,
    ResidualSpace,
    CvaResidual,
    Pls,
    MultiplePca,
    MultiwayPca,
    ParameterT2,
)


def chart(name: str) -> type[Chart]:
    """The chart of a name, which is in the catalogue."""
    return next(kind for kind in CHARTS if kind.name == name)


def design(name: str, arl0: float, shift: float, *, dimension: int = 2, rules: Iterable[int] = (1,)) -> Design:
    """Design the fastest chart of a kind for a shift.

    >>> design("cusum", 370.4, 1.0).parameters["k"]
    0.5

    Args:
        name: shewhart, ewma, cusum, t2 or mewma.
        arl0: run length without a shift, in [5, 1e8].
        shift: shift to be detected, in sigma (of several signals: Mahalanobis), in [0.1, 10].
        dimension: number of signals, of mewma and t2.
        rules: run rules, of shewhart.

    Raises:
        InputError: there is no such chart, or an argument out of its range.
    """
    check_range("arl0", arl0, SHORTEST_DESIGN, LONGEST_DESIGN)
    check_range("shift", shift, 0.1, 10.0)
    check_range("dimension", dimension, 1, MOST_SHIFTED_SIGNALS)
    kinds = {kind.name: kind for kind in CHARTS if "fastest" in vars(kind)}
    if name not in kinds:
        raise InputError(f"chart must be one of {', '.join(kinds)}, got {name!r}")
    return kinds[name].fastest(arl0, shift, dimension, checked_rules(rules))

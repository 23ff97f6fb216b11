"""The catalogue of control charts. A new one: a file here, and a line below.

From it come the names that `[monitor] charts` takes, the charts' own keys there, and their alarms.
"""

from reactorwatch.spc.charts.base import Chart
from reactorwatch.spc.charts.cusum import Cusum
from reactorwatch.spc.charts.cva_residual import CvaResidual
from reactorwatch.spc.charts.edetector import EDetector
from reactorwatch.spc.charts.ewma import Ewma
from reactorwatch.spc.charts.level import Level
from reactorwatch.spc.charts.mewma import Mewma
from reactorwatch.spc.charts.multiple_pca import MultiplePca
from reactorwatch.spc.charts.multiway_pca import MultiwayPca
from reactorwatch.spc.charts.parameters import ParameterT2
from reactorwatch.spc.charts.pca import PcaSpe, PcaT2
from reactorwatch.spc.charts.pls import Pls
from reactorwatch.spc.charts.residual_space import ResidualSpace
from reactorwatch.spc.charts.shewhart import Shewhart
from reactorwatch.spc.charts.t2 import T2

CHARTS: tuple[type[Chart], ...] = (
    Shewhart,
    Ewma,
    Cusum,
    EDetector,
    T2,
    Mewma,
    PcaT2,
    PcaSpe,
    ResidualSpace,
    CvaResidual,
    Level,
    Pls,
    MultiplePca,
    MultiwayPca,
    ParameterT2,
)


def chart(name: str) -> type[Chart]:
    """The chart of a name, which is in the catalogue."""
    return next(kind for kind in CHARTS if kind.name == name)

"""The catalogue of control charts. A new one: a file here, and a line below."""

from reactorwatch.spc.charts.cusum import Cusum
from reactorwatch.spc.charts.ewma import Ewma
from reactorwatch.spc.charts.mewma import Mewma
from reactorwatch.spc.charts.parameters import ParameterT2
from reactorwatch.spc.charts.pca import PcaSpe, PcaT2
from reactorwatch.spc.charts.shewhart import Shewhart
from reactorwatch.spc.charts.t2 import T2

CHARTS = (Shewhart, Cusum, Ewma, T2, Mewma, PcaT2, PcaSpe, ParameterT2)

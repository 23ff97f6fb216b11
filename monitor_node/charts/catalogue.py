"""The catalogue of control charts. A new one: a file here, and a line below."""

from monitor_node.charts.cusum import Cusum
from monitor_node.charts.ewma import Ewma
from monitor_node.charts.mewma import Mewma
from monitor_node.charts.parameters import ParameterT2
from monitor_node.charts.pca import PcaSpe, PcaT2
from monitor_node.charts.shewhart import Shewhart
from monitor_node.charts.t2 import T2

CHARTS = (Shewhart, Cusum, Ewma, T2, Mewma, PcaT2, PcaSpe, ParameterT2)

"""The catalogue of signal checks. A new one: a file here, and a line below."""

from monitor_node.checks.base import SignalCheck
from monitor_node.checks.range import RangeCheck
from monitor_node.checks.silence import SilenceCheck
from monitor_node.checks.spike import SpikeCheck
from monitor_node.checks.stuck import StuckCheck

CHECKS: tuple[type[SignalCheck], ...] = (SilenceCheck, StuckCheck, SpikeCheck, RangeCheck)

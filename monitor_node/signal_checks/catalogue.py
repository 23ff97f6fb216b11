"""The catalogue of signal checks. A new one: a file here, and a line below."""

from monitor_node.signal_checks.base import SignalCheck
from monitor_node.signal_checks.range import RangeCheck
from monitor_node.signal_checks.spike import SpikeCheck
from monitor_node.signal_checks.stuck import StuckCheck
from monitor_node.signal_checks.timeout import SilenceCheck

CHECKS: tuple[type[SignalCheck], ...] = (SilenceCheck, StuckCheck, SpikeCheck, RangeCheck)

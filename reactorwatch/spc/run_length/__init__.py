"""Average run lengths of charts, in control and after a shift.

In samples, for independent normal data with known mean and covariance.
"""

from reactorwatch.spc.run_length.cusum import cusum
from reactorwatch.spc.run_length.ewma import ewma
from reactorwatch.spc.run_length.mewma import mewma
from reactorwatch.spc.run_length.shewhart import shewhart
from reactorwatch.spc.run_length.t2 import t2

__all__ = ["cusum", "ewma", "mewma", "shewhart", "t2"]

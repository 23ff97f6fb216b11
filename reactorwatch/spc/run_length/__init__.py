"""How long a chart runs until it signals, by chance or after a shift.

Average run lengths in samples, for independent normal data and known mean and spread.
"""

from reactorwatch.spc.run_length.cusum import cusum
from reactorwatch.spc.run_length.ewma import ewma
from reactorwatch.spc.run_length.mewma import mewma
from reactorwatch.spc.run_length.shewhart import shewhart
from reactorwatch.spc.run_length.t2 import t2

__all__ = ["cusum", "ewma", "mewma", "shewhart", "t2"]

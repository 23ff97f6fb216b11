"""The process description, said once: models, their simulation, their steady states, and deviations from them."""

from reactorwatch.process.cstr import cstr

MODELS = (cstr,)
"""The process models there are: functions that build them."""

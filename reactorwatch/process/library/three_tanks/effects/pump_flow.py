"""Deviation of a pump's flow."""

from reactorwatch.process.effect import make_effect
from reactorwatch.process.input_effects import InputOffset

PUMP_FLOWS = tuple(
    make_effect(
        InputOffset,
        f"pump{pump}",
        f"The real flow of pump {pump} is Q{pump} + m.",
        __name__,
        location=f"pump{pump}",
        input=f"Q{pump}",
        label=f"wrong flow of pump {pump}",
        larger=f"{{}} cm3/s more from pump {pump}",
        smaller=f"{{}} cm3/s less from pump {pump}",
        unit="cm3/s",
        lower=-150.0,
        upper=150.0,
        typical=1.0,
    )
    for pump in (1, 2)
)

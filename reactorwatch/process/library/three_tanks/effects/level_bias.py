"""Bias of a level sensor."""

from reactorwatch.process.effect import make_effect
from reactorwatch.process.output_effects import OutputBias

LEVEL_BIASES = tuple(
    make_effect(
        OutputBias,
        f"h{tank}.bias",
        f"The measured level of tank {tank} is h{tank} + m.",
        __name__,
        location=f"h{tank}",
        output=f"h{tank}",
        label=f"bias of the level sensor of tank {tank}",
        labels={"ramp": f"drift of the level sensor of tank {tank}"},
        larger=f"level sensor of tank {tank} shows {{}} cm too much",
        smaller=f"level sensor of tank {tank} shows {{}} cm too little",
        unit="cm",
        lower=-62.0,
        upper=62.0,
        typical=1.0,
    )
    for tank in (1, 2, 3)
)

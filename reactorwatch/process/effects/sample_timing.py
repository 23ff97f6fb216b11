"""The coolant flow is stamped too late."""

from dataclasses import replace

import casadi as ca

from reactorwatch.process.effects.base import TIMING, Effect
from reactorwatch.process.integrate import symbolic_step
from reactorwatch.process.memory import positive
from reactorwatch.process.model import ProcessModel

STEPS = 2
"""Of the integrator, over m."""


class SampleTiming(Effect):
    """The plant has felt the input of a row for m already when the row is measured.

    The state of a row is taken for that at the moment from which on its input acts, and that is what passes into the
    state of the next row, with no time lost or gained. What is measured lies m later: y_k = h(Phi_m(x_k, u_k)). As long
    as m is constant and at most the time until the next row, that is exact, however irregular the rows; a larger m
    would need the input of later rows. While m changes, the plant's own time seems to run slower or faster, and the
    state is off for as long as the plant remembers.

    An input that is interpolated between the rows instead of held is, to first order, held with m of half a period.

    Of effects in one model this must come last: the outputs are those of the model that it is applied to, m later.
    """

    name = "sample_timing"
    label = "coolant flow stamped late, or interpolated"
    location = TIMING
    unit = "min"
    lower = 0.0
    upper = 0.5
    typical = 0.05

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        symbols, clock = model.arguments(), model.clock
        x, u, p = symbols
        step, shown = symbolic_step(model), model.function("shown")
        late = positive(size)
        h = late / STEPS
        for number in range(STEPS):
            x = step(x, u, p, clock.now + number * h, clock.middle, h)[0]
        later = ca.vertsplit(shown(x, u, p, clock.now + late, clock.middle)[1])
        return replace(
            model,
            outputs=tuple(replace(item, expression=y) for item, y in zip(model.outputs, later, strict=True)),
        )

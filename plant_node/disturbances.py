"""What disturbs the process itself, beside its faults: a random walk of its states.

A real reactor never follows its equations exactly: the feed is not mixed ideally, the reaction is not the same
everywhere. In the language of stochastic differential equations dx = f(x) dt + sd dW, where W is Brownian motion; so sd
has the unit of x per square root of a minute. Here the increment of a whole period is added at its end, which is the
discrete-time model that a Kalman filter assumes, x(k+1) = F(x(k)) + w(k) with Var w = sd^2 times the period: Jazwinski
(1970), Stochastic Processes and Filtering Theory, ch. 7. Unlike the noise of a sensor the plant carries it on.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt

from plant_node.noise import standard_normal
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel


@dataclass(frozen=True)
class ProcessNoise:
    """Moves one state at random.

    Attributes:
        state: its name.
        sd: in the state's unit per square root of a minute.
        period_min: between two rows.
        lower: the smallest value that the state can have; the noise does not move it beyond.
        upper: the largest.
        seed: of the noise.
    """

    state: str
    sd: float
    period_min: float
    lower: float
    upper: float
    seed: int

    def moved(self, value: float, row: int) -> float:
        """The state at a row of the run, where its equations took it to `value` from the row before."""
        increment = self.sd * sqrt(self.period_min) * standard_normal(self.seed, f"process {self.state}", row)
        # A state that the equations themselves took beyond its bounds is not pulled back: that would be no noise.
        return min(max(value + increment, min(self.lower, value)), max(self.upper, value))


def process_noise(
    sd: Mapping[str, float], model: ProcessModel, period_min: float, seed: int
) -> list[tuple[int, ProcessNoise]]:
    """The noise of each state that has some, with the index of the state.

    Args:
        sd: by name of the state; see `ProcessNoise`.
        model: the process; faults put states of their own behind its states.
        period_min: between two rows.
        seed: of the noise.

    Raises:
        InputError: a state that there is not.
    """
    names = model.state_names
    for name in sd:
        if name not in names:
            raise InputError(f"process_noise_sd: {model.name} has no state {name!r} (valid: {', '.join(names)})")
    return [
        (index, ProcessNoise(state.name, sd[state.name], period_min, state.lower, state.upper, seed))
        for index, state in enumerate(model.states)
        if sd.get(state.name, 0.0)
    ]

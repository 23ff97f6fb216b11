"""Process noise: a random walk of the states.

A real reactor never follows its equations exactly: the feed is not mixed ideally, the reaction is not uniform. As a
stochastic differential equation, dx = f(x) dt + sd dW with W Brownian motion; so sd has the unit of x per square root
of a minute. Here the increment of a period is added at its end, which is the discrete-time model that a Kalman filter
assumes, x(k+1) = F(x(k)) + w(k) with Var w = sd^2 times the period: Jazwinski (1970), Stochastic Processes and
Filtering Theory, ch. 7. Unlike sensor noise it acts on the states, and so on later rows.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt

from plant_node.noise import standard_normal
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel


@dataclass(frozen=True)
class ProcessNoise:
    """Process noise of one state.

    Attributes:
        state: name of the state.
        sd: noise level, in the state's unit per square root of a minute.
        period_min: sampling period.
        lower: lower bound of the state; the noise does not move it beyond.
        upper: upper bound of the state.
        seed: seed of the noise.
    """

    state: str
    sd: float
    period_min: float
    lower: float
    upper: float
    seed: int

    def add_to(self, value: float, row: int) -> float:
        """Add the noise of a row to the integrated value of the state."""
        increment = self.sd * sqrt(self.period_min) * standard_normal(self.seed, f"process {self.state}", row)
        # A state that the equations took beyond its bounds is not pulled back: that would not be noise.
        return min(max(value + increment, min(self.lower, value)), max(self.upper, value))


def process_noise(
    sd: Mapping[str, float], model: ProcessModel, period_min: float, seed: int
) -> list[tuple[int, ProcessNoise]]:
    """Make the process noise of each state with a level above 0, with the index of the state.

    Args:
        sd: noise levels by name of the state; see `ProcessNoise`.
        model: the process; states of faults come after its own.
        period_min: sampling period.
        seed: seed of the noise.

    Raises:
        InputError: an unknown state.
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

"""The problem of a diagnosis: a record, its model, the catalogue, priors and tolerances."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.parameter_priors import add_priors
from reactorwatch.diagnosis.run import Run
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import Record


@dataclass(frozen=True, eq=False)
class Problem:
    """A record to be explained, with its model, catalogue, priors and tolerances.

    Attributes:
        record: the record.
        run: its rows as the filter takes them.
        model: process model with the stated values of its parameters.
        effects: effects that may be named.
        stated: standard deviations of parameters, by name, in their units; those of 0 are exact.
        tolerances: root mean square difference that does not matter in practice, by output, in its unit.
        limits: lowest and highest value allowed in an experiment, by input and output.
        smallest_sd: lower bound of each sensor's noise.
    """

    record: Record
    run: Run
    model: ProcessModel
    effects: tuple[Effect, ...]
    stated: Mapping[str, float]
    tolerances: Mapping[str, float]
    limits: Mapping[str, tuple[float, float]]
    smallest_sd: Sequence[float]

    @cached_property
    def plant(self) -> ProcessModel:
        """The model with an offset of each uncertain parameter."""
        return add_priors(self.model, self.stated)

    @property
    def uncertain(self) -> dict[str, float]:
        """Standard deviations of the parameters that are not exact, by name."""
        return {name: sd for name, sd in self.stated.items() if sd > 0.0}

    @property
    def bands(self) -> Array:
        """Tolerances in the order of the outputs, shape (n_y,)."""
        return np.array([self.tolerances[name] for name in self.model.output_names])

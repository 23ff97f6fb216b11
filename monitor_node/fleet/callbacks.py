"""Functions through which a fleet's monitor reaches the world: the storage of states, the bus, the diagnoses."""

from collections.abc import Callable
from typing import NamedTuple

from monitor_node.baseline.training_diagnosis import DiagnosisJob
from monitor_node.core import Monitor
from monitor_node.fleet.watched_plants import State
from reactorwatch.errors import InputError


class Callbacks(NamedTuple):
    """Functions of the node; by default none does anything.

    Attributes:
        request_history: called with a plant to adopt, and True if another owned it until now; returns True if its
            history will be passed to `on_history`. If not, the plant is adopted at once.
        store: called with a released plant and its state.
        unusable: called with a plant whose state is unusable, and the reason; returns a note on the state.
        put_back: called with a plant without a usable state, and its new monitor; returns True if the monitor was
            restored from a state that had been kept aside.
        claimed_elsewhere: returns True if another monitor has claimed a plant since it was adopted here.
        on_ownership: called with True when a plant is adopted, and with False when it is released.
        diagnose: called with an own plant and the diagnosis of its training, which is passed to `on_finding`.
    """

    request_history: Callable[[str, bool], bool] = lambda _plant, _taken_over: False
    store: Callable[[str, State], None] = lambda _plant, _state: None
    unusable: Callable[[str, InputError], str] = lambda _plant, _why: ""
    put_back: Callable[[str, Monitor], bool] = lambda _plant, _monitor: False
    claimed_elsewhere: Callable[[str], bool] = lambda _plant: False
    on_ownership: Callable[[str, bool], None] = lambda _plant, _ours: None
    diagnose: Callable[[str, DiagnosisJob], None] = lambda _plant, _job: None


NO_CALLBACKS = Callbacks()

"""Operation of the reactor, and its named runs: the four records of the study that this project starts from.

The default levels keep the nominal plant on its operating branch; a large or fast enough change of the coolant flow
extinguishes it.

Of the named runs one is fault-free and three have a fault. They differ in their fault only: same input, same noise,
same length, and with the same seed the same rows until the fault sets in, two hours of monitoring after the hundred
minutes of training. The flow goes up to 105 l/min instead of 111, where the slower reaction would extinguish.

Input leakage: the input is the coolant flow, so coolant leaks between the valve and the jacket while `qc` remains the
command. Of internal parameters, the two that change in a real plant: heat transfer, as the jacket fouls, and the
reaction rate, as a catalyst deactivates. They differ in kind, too. Less heat transfer warms the reactor as the leakage
does, and differs from it only in its dependence on the flow; a slower reaction cools it. (The activation energy would
be a second name for the rate: near one temperature a change of E/R is one of k0.)

The sizes move the operating point by several standard deviations of the thermometer, and keep the plant on its
operating branch.
"""

from reactorwatch.process.library.cstr.examples import EXAMPLES
from reactorwatch.process.operation import InputLevels, Operation, Preset, WatchDefaults

ONSET_MIN = 220.0
DURATION_MIN = 400.0
NOISE_SD = {"C": 0.002, "T": 0.3, "qc": 0.0}


def _preset(name: str, meaning: str, *faults: str) -> Preset:
    settings = {
        "duration_min": DURATION_MIN,
        "scenario": {"kind": "random-steps", "low": 85.0, "high": 105.0, "hold_min": 1.0},
        "noise_sd": NOISE_SD,
        "faults": [f"{fault}@{ONSET_MIN:g}min" for fault in faults],
    }
    return Preset(name, meaning, settings)


OPERATION = Operation(
    inputs={"qc": InputLevels(level=100.0, low=90.0, high=111.0, swing=5.0)},
    noise_sd=NOISE_SD,
    fault="coolant_flow:step:-0.15",
    presets=(
        _preset("fault-free", "nothing is wrong"),
        _preset("input-leakage", "a tenth of the coolant leaks out", "coolant_flow:step:-0.1"),
        _preset("heat-transfer", "half of the heat transfer is gone", "heat_transfer:step:-0.5"),
        _preset("reaction-rate", "the reaction is a tenth slower", "reaction_rate:step:-0.1"),
    ),
    examples=EXAMPLES,
    watch=WatchDefaults(
        training_min=100.0,
        smallest_sd={"C": 2e-4, "T": 0.05},
        priorities={"T": "high"},
        identified=("T",),
    ),
)

"""Levels of pcgym's four tanks, run by the Python of an environment that has pcgym: JSON from stdin to stdout."""

import json
import sys

import numpy as np
from pcgym import make_env
from pcgym.model_classes import four_tank

job = json.load(sys.stdin)
levels = [job["start"]]
for stretch in job["stretches"]:
    rows = len(stretch["inputs"])
    settings = {
        "model": "four_tank",
        "custom_model": four_tank(**stretch["constants"]),
        "N": rows,
        "tsim": job["period_s"] * rows,
        "x0": np.array([*levels[-1], 0.0]),
        "SP": {"h1": [0.0] * (rows + 1)},
        "a_space": {"low": np.zeros(2), "high": np.full(2, 10.0)},
        "o_space": {"low": np.zeros(5), "high": np.ones(5)},
    }
    env = make_env(settings | {"normalise_a": False, "normalise_o": False})
    env.reset()
    levels += [env.step(np.array(inputs))[0][:4].tolist() for inputs in stretch["inputs"]]
json.dump(levels[:-1], sys.stdout)

"""Bias of a level sensor."""

from typing import ClassVar

from reactorwatch.process.output_effects import OutputBias


class LevelBias(OutputBias):
    """The measured level is h + m."""

    unit = "cm"
    lower = -62.0
    upper = 62.0
    typical = 1.0


class Level1Bias(LevelBias):
    """The measured level of tank 1 is h1 + m."""

    name = "h1.bias"
    location = output = "h1"
    label = "bias of the level sensor of tank 1"
    larger = "level sensor of tank 1 shows {} cm too much"
    smaller = "level sensor of tank 1 shows {} cm too little"
    labels: ClassVar[dict[str, str]] = {"ramp": "drift of the level sensor of tank 1"}


class Level2Bias(LevelBias):
    """The measured level of tank 2 is h2 + m."""

    name = "h2.bias"
    location = output = "h2"
    label = "bias of the level sensor of tank 2"
    larger = "level sensor of tank 2 shows {} cm too much"
    smaller = "level sensor of tank 2 shows {} cm too little"
    labels: ClassVar[dict[str, str]] = {"ramp": "drift of the level sensor of tank 2"}


class Level3Bias(LevelBias):
    """The measured level of tank 3 is h3 + m."""

    name = "h3.bias"
    location = output = "h3"
    label = "bias of the level sensor of tank 3"
    larger = "level sensor of tank 3 shows {} cm too much"
    smaller = "level sensor of tank 3 shows {} cm too little"
    labels: ClassVar[dict[str, str]] = {"ramp": "drift of the level sensor of tank 3"}

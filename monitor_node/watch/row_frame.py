"""Numbers of a plant's stages, and the constants and results of the compiled step, as records and as arrays.

A plant's numbers are one record, whose type is composed of the stages' own and differs with the numbers of inputs,
outputs and alarms. The compiled step (`row_step`) is to be the same machine code for all plants, so it is given a
frame: these numbers, and the addresses of the records' fields.
"""

from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from monitor_node.alarms.alarms import DELAY
from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import carray, jit, pointer_at
from reactorwatch.spc.charts.cusum import Cusum
from reactorwatch.spc.charts.ewma import Ewma
from reactorwatch.spc.charts.level import Level
from reactorwatch.spc.charts.level import count_numbers as count_level_numbers
from reactorwatch.spc.charts.level import numbers_in_kernel as level_numbers_in_kernel
from reactorwatch.spc.charts.mewma import Mewma, count_numbers
from reactorwatch.spc.charts.shewhart import Shewhart
from reactorwatch.spc.compiled_chart import SETTINGS
from reactorwatch.spc.prewhitening import WHITENER
from reactorwatch.spc.silence import TIMEOUT
from reactorwatch.spc.stuck import STUCK

CHARTS = (Shewhart.name, Ewma.name, Cusum.name, Mewma.name, Level.name)
"""Charts that the step has, in its order."""

POINT = 5
"""Numbers of a chart's point: those of a `Judgement`."""

_SHEWHART, _EWMA, _CUSUM = Shewhart.numbers, Ewma.numbers, Cusum.numbers
_COLUMNS = SETTINGS + max(_SHEWHART, _EWMA, _CUSUM)

Records: TypeAlias = NDArray[np.void]
Words: TypeAlias = NDArray[np.int64]

HEAD = np.dtype([("last_ns", "i8"), ("period_ns", "f8"), ("time_min", "f8")])
"""Time of the newest row; sampling period; time of the filter's newest row."""

CONSTANTS = np.dtype(
    [
        ("filter_address", "i8"),  # address of the filter's machine code; 0: a black box
        ("spacing_min", "f8", (2,)),  # shortest and longest time between two rows
        ("silence_limit", "f8"),  # see `DataTimeout`
        ("charts", "i8", (len(CHARTS),)),  # index of the first alarm of each chart; -1: there is no such chart
        ("reach", "f8"),  # see `is_ordinary`
        ("weight", "f8"),  # weight of the MEWMA chart
    ],
    align=True,
)
"""Constants of a step whose number is the same for all plants."""


class FrameTypes(NamedTuple):
    """Types of the records of a step.

    Attributes:
        numbers: numbers of a plant's stages, composed of the stages' own; the filter has its belief elsewhere.
        work: results of a step.
        settings: constants of a step.
    """

    numbers: np.dtype[Any]
    work: np.dtype[Any]
    settings: np.dtype[Any]


@lru_cache(maxsize=64)
def frame_types(inputs: int, outputs: int, alarms: int) -> FrameTypes:
    """Types of the records of a step, which all plants of a kind share."""
    numbers = [
        *((name, HEAD[name]) for name in HEAD.names or ()),
        ("inputs", "f8", (inputs,)),  # inputs of that row
        ("timeouts", TIMEOUT, (1 + inputs + outputs,)),  # of the plant, each input and each output
        ("whiteners", WHITENER, (outputs,)),
        ("stuck", STUCK, (outputs,)),
        ("spike_limits", "f8", (outputs,)),
        ("shewhart", "f8", (Shewhart.numbers, outputs)),
        ("ewma", "f8", (Ewma.numbers, outputs)),
        ("cusum", "f8", (Cusum.numbers, outputs)),
        ("mewma", "f8", (count_numbers(outputs),)),
        ("level", "f8", (count_level_numbers(inputs, outputs),)),  # fewer where a signal does not vary
        ("level_signals", "i8", (1 + inputs + outputs,)),  # number of its signals, and the index of each
        ("delays", DELAY, (max(alarms, 1),)),
    ]
    work = [
        ("new", "f8", (3 + 2 * inputs + 2 * outputs,)),  # new values of the filter, see `ekf_step.row_function`
        ("outputs", "f8", (5 * outputs + 1,)),  # its results
        ("e", "f8", (outputs,)),  # prewhitened residuals
        ("values", "f8", (inputs + outputs,)),  # values of the signals of the chart of levels
        ("columns", "f8", (_COLUMNS, outputs)),  # columns of a bank of charts, see `compiled_chart`
        ("points", "f8", (max(alarms, 1), POINT)),  # points of the charts, one row an alarm
    ]
    settings = [
        ("constants", CONSTANTS),
        ("resolutions", "f8", (outputs,)),  # stated resolution of each output; 0 where it is learned
        ("ranges", "f8", (inputs + outputs, 2)),  # smallest and largest value of each signal
        ("rules", "i8", (max(alarms, 1), 2)),  # violating points that raise each alarm, mask of its window
    ]
    return FrameTypes(*(np.dtype(fields, align=True) for fields in (numbers, work, settings)))


class Plant(NamedTuple):
    """Numbers of a plant's stages, see `FrameTypes`; within the compiled step."""

    head: Any
    inputs: Array
    timeouts: Any
    whiteners: Any
    stuck: Any
    spike_limits: Array
    shewhart: Array
    ewma: Array
    cusum: Array
    mewma: Array
    level: Array
    level_signals: Words
    delays: Any


class Work(NamedTuple):
    """Results of a step, see `FrameTypes`; within the compiled step."""

    new: Array
    outputs: Array
    e: Array
    values: Array
    columns: Array
    points: Array


class Settings(NamedTuple):
    """Constants of a step, see `FrameTypes`; within the compiled step."""

    constants: Any
    resolutions: Array
    ranges: Array
    rules: Words


_FIRST = 3
_P = _FIRST + len(HEAD.names or ()) - 1  # `head` takes the place of its three fields
_WORK = _P + len(Plant._fields)
_SETTINGS = _WORK + len(Work._fields)


def frame_of(sizes: tuple[int, int, int], scratch: Records, work: Records, settings: Records) -> Words:
    """Sizes of a plant and addresses of the arrays of its step, which the caller keeps alive.

    Returns:
        the sizes, then the addresses of the fields.
    """
    addresses = [
        records[name].ctypes.data for records in (scratch, work, settings) for name in records.dtype.names or ()
    ]
    return np.array([*sizes, *addresses], dtype=np.int64)


def words_of(numbers: Records) -> Words:
    """Numbers of a plant as words, shape (words,): a view."""
    words: Words = numbers.view(np.int64).reshape(-1)
    return words


@jit
def scratch_at(frame: Words, words: int) -> Words:
    """Numbers of the plant that a step works on, as words."""
    scratch: Words = carray(pointer_at(frame[_FIRST]), (words,), np.int64)
    return scratch


@jit
def plant_at(frame: Words) -> Plant:
    """The same as arrays."""
    inputs, outputs, alarms = frame[0], frame[1], max(frame[2], 1)
    return Plant(
        carray(pointer_at(frame[_FIRST]), (1,), HEAD),
        carray(pointer_at(frame[_P + 1]), (inputs,), np.float64),
        carray(pointer_at(frame[_P + 2]), (1 + inputs + outputs,), TIMEOUT),
        carray(pointer_at(frame[_P + 3]), (outputs,), WHITENER),
        carray(pointer_at(frame[_P + 4]), (outputs,), STUCK),
        carray(pointer_at(frame[_P + 5]), (outputs,), np.float64),
        carray(pointer_at(frame[_P + 6]), (_SHEWHART, outputs), np.float64),
        carray(pointer_at(frame[_P + 7]), (_EWMA, outputs), np.float64),
        carray(pointer_at(frame[_P + 8]), (_CUSUM, outputs), np.float64),
        carray(pointer_at(frame[_P + 9]), (1 + 2 * outputs + 2 * outputs * outputs,), np.float64),
        carray(pointer_at(frame[_P + 10]), (level_numbers_in_kernel(inputs, outputs),), np.float64),
        carray(pointer_at(frame[_P + 11]), (1 + inputs + outputs,), np.int64),
        carray(pointer_at(frame[_P + 12]), (alarms,), DELAY),
    )


@jit
def work_at(frame: Words) -> Work:
    """Results of a step as arrays."""
    inputs, outputs, alarms = frame[0], frame[1], max(frame[2], 1)
    return Work(
        carray(pointer_at(frame[_WORK]), (3 + 2 * inputs + 2 * outputs,), np.float64),
        carray(pointer_at(frame[_WORK + 1]), (5 * outputs + 1,), np.float64),
        carray(pointer_at(frame[_WORK + 2]), (outputs,), np.float64),
        carray(pointer_at(frame[_WORK + 3]), (inputs + outputs,), np.float64),
        carray(pointer_at(frame[_WORK + 4]), (_COLUMNS, outputs), np.float64),
        carray(pointer_at(frame[_WORK + 5]), (alarms, POINT), np.float64),
    )


@jit
def settings_at(frame: Words) -> Settings:
    """Constants of a step as arrays."""
    inputs, outputs, alarms = frame[0], frame[1], max(frame[2], 1)
    return Settings(
        carray(pointer_at(frame[_SETTINGS]), (1,), CONSTANTS),
        carray(pointer_at(frame[_SETTINGS + 1]), (outputs,), np.float64),
        carray(pointer_at(frame[_SETTINGS + 2]), (inputs + outputs, 2), np.float64),
        carray(pointer_at(frame[_SETTINGS + 3]), (alarms, 2), np.int64),
    )

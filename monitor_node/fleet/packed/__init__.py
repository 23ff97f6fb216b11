"""Plants of a fleet in their normal state, in arrays: a record of numbers each, and a ring of their newest rows.

A plant is packed when it is past its training and nothing happens. Its samples are then aligned, and its rows go
through the step of `row_step`, many plants at a time. As soon as anything is an event the plant gets a monitor again,
made from the same numbers, which processes the event. So publications are the same in both forms, value for value.

Plants are packed whose rows the step can take: with the filter of a process model as reference, and Shewhart, EWMA,
CUSUM and MEWMA charts, as by default. Others keep their monitors.

| file | contents |
|---|---|
| `record` | type of a plant's record, beside the numbers of its stages |
| `samples` | alignment of samples, compiled |
| `rows` | rows through the step, compiled |
| `ring` | newest rows, compressed without loss, compiled |
| `pending` | conversion of the alignment's state |
| `conversion` | conversion of a monitor's state |
| `array` | the arrays |
| `plants` | the packed plants, as a fleet uses them |
"""

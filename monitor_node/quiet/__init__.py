"""Plants in which nothing happens, held as arrays: a record of numbers each, and a ring of their newest rows.

A plant comes here from its monitor when it is past its training and at rest. Its samples are then lined up and its rows
judged many at a time. As soon as something is out of the ordinary it goes back to a monitor of its own, which does not
know that it ever was away: all that it would remember is put together from the record, and the row in question is its
to judge. So what is said of a plant is the same, value for value, whoever watches it.

Held here are plants that are judged by the filter of a process model, with Shewhart, EWMA, CUSUM and MEWMA charts, as
by default; others keep their monitors.

| file | is |
|---|---|
| `layout` | the form of a record |
| `samples` | samples on their way into rows, by compiled code |
| `rows` | rows judged by compiled code |
| `lining_up`, `learned`, `ring` | between a record and what parts of a monitor remember |
| `form` | between a record and all that a monitor remembers |
| `slots` | the arrays |
| `plants` | the plants, as a fleet sees them |
"""

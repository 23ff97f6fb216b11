"""Diagnosis: from a measured run and a model to the cause of their difference, the extended model and its gain.

`diagnose` does it all; the parts, from the bottom up:

- `fitting`: `profiles` of a deviation in time, the `augmented_model` and its `filter`, linearised `signatures`,
  and `hypothesis`: effects with profiles, fitted to a run; `simulation`: parameters of a model, fitted to a run.
- `search`: `screen` finds hypotheses worth fitting; `search` the best of them and its alternatives.
- `law`: smooth corrections in each place of the process locate an unknown, and formulas give its law.
- `unknown_input`: `localise` does so for a disturbance that wanders in time.
- `experiment`: an input that separates alternatives.
- `whiteness`, `holdout`: test of the innovations, and gain on rows that were not fitted.
- `result`: the result; `report`: the result as text, JSON and a page.

It works on any `ProcessModel` with a catalogue of effects.
"""

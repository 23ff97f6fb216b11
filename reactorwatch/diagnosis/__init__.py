"""Measured run and model in; what is wrong, its cause, the extended model and the gain out.

`diagnose` does it all; the modules, from the bottom up:

- `courses`: how a deviation goes in time; `augmented_model`: a model in which it may go so.
- `signatures`: what it does to a filter's innovations, linearised, of all causes at once.
- `hypothesis`: effects with courses, fitted to a run.
- `screen`: which hypotheses are worth fitting; `search`: the best of them, and its rivals.
- `unknown`: where something acts that no hypothesis has; `forcing`, `smoother`: what it does there.
- `holdout`, `adequacy`: what was gained, and whether anything is left.
- `result`: what is said in the end.

Nothing here knows the reactor: it works on any `ProcessModel` and a catalogue of its effects.
"""

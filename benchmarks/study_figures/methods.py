"""The methods of the report's literature review, each with its place in this software."""

METHODS = (
    ("linearisation by Taylor series", "linear model at a steady state", "`reactorwatch linearise`"),
    (
        "feedback linearisation",
        "state feedback that cancels the nonlinearity",
        "none: it is a controller, not a monitor",
    ),
    ("white-box model", "balances and laws of nature", "process with equations; reference `equations`"),
    (
        "grey-box model",
        "balances with parts learned from data",
        "`diagnose`, which extends the equations by what it finds",
    ),
    ("black-box model", "relation of input and output alone", "`identify`; references `black-box` and `arx`"),
    ("ARX, least squares", "linear in its parameters", "`identify --model arx`, also row by row (`--recursive`)"),
    ("ARMAX", "ARX with a model of the noise", "`identify --model armax`"),
    ("output error", "fitted by its simulation", "`identify --model oe`"),
    (
        "Shewhart limits, mean +- 3 sigma",
        "one point at a time",
        "chart `shewhart`",
    ),
    ("multivariate control charts", "outputs judged together, with their correlation", "charts `t2` and `mewma`"),
    (
        "PCA, contribution plots",
        "few directions explain many signals; shares of an alarm",
        "chart `pca`; `contributions` of each alarm",
    ),
    (
        "PLS",
        "directions that explain a quality variable",
        "none yet: no process here has a quality variable apart from its outputs",
    ),
    ("multi-way PCA", "batches unfolded over time", "none yet: the processes here run continuously"),
    (
        "several PCA models, soft partition",
        "one model for each regime",
        "none yet: a mode has a reference of its own instead",
    ),
    (
        "neural network (recommended)",
        "nonlinear predictor",
        "none: no product, only a figure of this study (`benchmarks/study_figures/neural.py`)",
    ),
)


def methods_table() -> str:
    """The methods as a Markdown table."""
    rows = "\n".join(f"| {method} | {meaning} | {place} |" for method, meaning, place in METHODS)
    return f"| method | meaning | place in this software |\n|---|---|---|\n{rows}"

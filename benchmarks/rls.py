"""Speed of one recursive least squares update of ARX(3,3).

Against padasip's FilterRLS.adapt on the same rows. The two take turns, so that whatever else the machine does meets
both of them; printed are the medians over the rounds, of the times and of the ratios within a round.
"""

from time import perf_counter

import numpy as np
from padasip.filters import FilterRLS

from reactorwatch.identification.rls import RecursiveLeastSquares

PARAMETERS = 7
ROWS = 2000
ROUNDS = 25


def main() -> None:
    """Measure and print."""
    rng = np.random.default_rng(1)
    rows, outputs = rng.standard_normal((ROWS, PARAMETERS)), rng.standard_normal(ROWS)
    regressors, measured = list(rows), outputs.tolist()
    print(f"microseconds an update of {PARAMETERS} parameters, median of {ROUNDS} rounds")
    print(f"{'forgetting':>10} {'padasip':>9} {'single':>9} {'ratio':>6}")
    for forgetting in (1.0, 0.999):
        padasip = FilterRLS(PARAMETERS, mu=forgetting)
        single = RecursiveLeastSquares(PARAMETERS, forgetting)
        single.update(regressors[0], measured[0])  # compiles, or loads what was compiled
        times: dict[str, list[float]] = {"padasip": [], "single": []}
        for _ in range(ROUNDS):
            start = perf_counter()
            for regressor, output in zip(regressors[:500], measured[:500], strict=True):
                padasip.adapt(output, regressor)
            times["padasip"].append((perf_counter() - start) / 500)
            start = perf_counter()
            for regressor, output in zip(regressors, measured, strict=True):
                single.update(regressor, output)
            times["single"].append((perf_counter() - start) / ROWS)
        theirs, alone = (1e6 * np.array(times[name]) for name in ("padasip", "single"))
        print(f"{forgetting:>10} {np.median(theirs):>9.3f} {np.median(alone):>9.3f} {np.median(theirs / alone):>6.1f}")


if __name__ == "__main__":
    main()

"""Published run lengths: by the source, each a chart's arguments, the shifts, and the numbers."""

from typing import TypeVar

Key = TypeVar("Key")

# Champ & Woodall (1987), Technometrics 29(4), table 2. The rules; then by shift.
RUN_RULES = {
    (1,): {0.0: 370.40, 0.2: 308.43, 0.4: 200.08, 0.6: 119.67, 0.8: 71.55, 1.0: 43.89, 2.0: 6.30, 3.0: 2.00},
    (1, 2): {0.0: 225.44, 0.2: 177.56, 0.4: 104.46, 0.6: 57.92, 0.8: 33.12, 1.0: 20.01, 2.0: 3.65, 3.0: 1.68},
    (1, 3): {0.0: 166.05, 0.2: 120.70, 0.4: 63.88, 0.6: 33.99, 0.8: 19.78, 1.0: 12.66, 2.0: 3.68, 3.0: 1.89},
    (1, 4): {0.0: 152.73, 0.2: 110.52, 0.4: 59.76, 0.6: 33.64, 0.8: 21.07, 1.0: 14.58, 2.0: 4.89, 3.0: 1.99},
    (1, 2, 3, 4): {0.0: 91.75, 0.2: 66.80, 0.4: 36.61, 0.6: 20.91, 0.8: 13.25, 1.0: 9.22, 2.0: 3.13, 3.0: 1.67},
}

_SHIFTS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0)
# Lucas & Crosier (1982), Technometrics 24(3), and Montgomery, Introduction to Statistical Quality Control: k = 0.5. The
# limit and the head start; then by shift.
CUSUM = {
    (4.0, 0.0): dict(zip(_SHIFTS, (167.684, 74.2, 26.6, 13.3, 8.38, 4.75, 3.34, 2.19, 1.71), strict=True)),
    (4.0, 2.0): dict(zip(_SHIFTS, (149, 62.7, 20.1, 8.97, 5.29, 2.86, 2.01, 1.32, 1.07), strict=True)),
    (5.0, 0.0): dict(zip(_SHIFTS, (465.444, 139.494, 37.996, 17.048, 10.376, 5.75, 4.01, 2.57, 2.01), strict=True)),
    (4.774, 0.0): {0.0: 370.06},
}
HIGH_SUM = {4.0: 335.37, 5.0: 930.89}

# Lucas & Saccucci (1990), Technometrics 32(1), table 3; the last from the SAS/QC manual (1999). Lambda and L; by shift.
EWMA = {
    (0.50, 3.071): {0.0: 500, 0.5: 88.8, 1.0: 17.5, 2.0: 3.63, 3.0: 1.93},
    (0.40, 3.054): {0.0: 499.95, 0.5: 71.20, 1.0: 14.26, 2.0: 3.52, 3.0: 2.02},
    (0.25, 2.998): {0.0: 499.84, 0.5: 48.29, 1.0: 11.14, 2.0: 3.61, 3.0: 2.26},
    (0.20, 2.962): {0.0: 499.74, 0.5: 41.76, 1.0: 10.54, 2.0: 3.74, 3.0: 2.38},
    (0.10, 2.814): {0.0: 499.58, 0.5: 31.30, 1.0: 10.33, 2.0: 4.36, 3.0: 2.87},
    (0.05, 2.615): {0.0: 499.93, 0.5: 28.76, 1.0: 11.38, 2.0: 5.22, 3.0: 3.50},
    (0.03, 2.437): {0.0: 500, 0.5: 29.3, 1.0: 12.6, 2.0: 5.99, 3.0: 4.03},
    (0.25, 3.0): {1.0: 11.154267},
}

# Molnau et al. (2001), J. Quality Technology 33, p = 4; Prabhu & Runger (1997), J. Quality Technology 29, p = 2.
# Rigdon (1995), Statist. Probab. Letters 24, table 1, p = 5. The dimension, lambda and H; then by shift.
MEWMA = {
    (4, 0.1, 12.73): {0.0: 199.78, 0.5: 35.05, 1.0: 12.17, 1.5: 7.22, 2.0: 5.19, 3.0: 3.42},
    (2, 0.1, 8.64): {0.0: 200.5, 1.0: 10.12, 2.0: 4.41},
    (2, 0.2, 9.65): {0.0: 200.2, 1.0: 10.16, 2.0: 3.77},
    (5, 0.1, 14.56): {1.0: 12.9},
}

# Chi-square tables: the limits for an in-control run length of 200, 370.4 and 500; and by shift.
T2_LIMITS = {2: {200: 10.597, 370.4: 11.829, 500: 12.429}, 3: {200: 12.838, 370.4: 14.156, 500: 14.796}}
T2 = {(2, 10.597): {1.0: 41.92, 2.0: 6.88}}

_STEADY_SHIFTS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0)
# Crosier (1986), Technometrics 28, table 5: the usual two-sided CUSUM, k = 0.5, h = 4, steady state.
STEADY_CUSUM = dict(zip(_STEADY_SHIFTS, (163, 71.6, 25.2, 12.3, 7.68, 4.31, 3.03, 2.38, 2.00, 1.55, 1.22), strict=True))
# Lucas & Saccucci (1990), table 3, steady state.
STEADY_EWMA = {
    (0.50, 3.071): {0.0: 499, 0.25: 254, 0.5: 88.4, 0.75: 35.7, 1.0: 17.3, 1.5: 6.44, 2.0: 3.58, 3.0: 1.91},
    (0.03, 2.437): {0.0: 480, 0.25: 74.1, 0.5: 28.6, 0.75: 17.3, 1.0: 12.5, 1.5: 8.00, 2.0: 5.95, 3.0: 4.02},
}
# Rhoads, Montgomery & Mastrangelo (1996), Quality Engineering 9, table 1: lambda 0.03, L 2.437, limits that vary from
# the start, to one decimal. Not here: their 20.0 at a shift of 0.5, where the integral equation gives 20.42, and
# those of Steiner (1999), J. Quality Technology 31, which are 1 to 4 % off it (lambda 0.05, L 3, shift 1: 9.0 against
# 9.24). `test_the_published_start_of_the_ewma_is_off` holds by simulation that it is those numbers that are off.
EXACT_LIMITS_EWMA = {1.0: 6.5, 1.5: 3.3, 2.0: 2.2, 3.0: 1.3, 4.0: 1.1}


def flat(table: dict[Key, dict[float, float]]) -> list[tuple[Key, float, float]]:
    """Arguments, shift and number, one by one."""
    return [(arguments, shift, length) for arguments, lengths in table.items() for shift, length in lengths.items()]

"""Models of a plant whose equations are unknown, which predict its rows with honest variances."""

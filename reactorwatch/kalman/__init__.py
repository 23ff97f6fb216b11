"""Extended Kalman filtering of a process model over measured rows."""

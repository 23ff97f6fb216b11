"""Machine code for numerical kernels, from CasADi functions and from Python."""

"""Measured run and model in; what is wrong, its cause, the extended model and the gain out."""

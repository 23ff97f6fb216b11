"""Design of an experiment that separates explanations."""

"""Design of an experiment that separates alternative explanations."""

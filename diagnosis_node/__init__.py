"""The node that diagnoses a plant's record after an alarm."""

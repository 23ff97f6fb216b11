"""The monitor's models: learned from measured rows, sample by sample or from a record. Pure."""

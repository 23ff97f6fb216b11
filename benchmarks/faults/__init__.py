"""The bank of faults that the monitor is measured on: what `benchmarks/fault_bank.py` is made of."""

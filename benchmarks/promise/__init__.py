"""Sound plants that are not quite the model, and the alarms that the monitor raises on them: `make promise`.

A promise about false alarms is worth what it is on plants as they are. The plants here are simulated by equations
written out in this folder, not by the product's simulator.
"""

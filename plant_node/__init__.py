"""The simulated plant as a node: equations, valve and sensors, driven by a scenario, disturbed by faults."""

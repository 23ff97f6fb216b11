"""The shell that all nodes share: the bus, the loop, the configuration. No node's own logic."""

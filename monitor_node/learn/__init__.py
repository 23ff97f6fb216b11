"""The training: what is learned of a plant before it is watched."""

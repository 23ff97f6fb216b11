"""Location of an unknown, by its effect on each balance, and its law as a function of states and inputs."""

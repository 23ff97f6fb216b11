"""Functions and classes behind the public names of `reactorwatch`, and behind its commands."""

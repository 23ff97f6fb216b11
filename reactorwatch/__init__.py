"""reactorwatch: watches a chemical reactor as it runs, and explains it when it misbehaves."""

__version__ = "0.1.0"

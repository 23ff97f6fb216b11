"""One monitor for many plants, and several that share them (docs/fleet.md)."""

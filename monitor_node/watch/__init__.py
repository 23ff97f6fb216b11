"""Pipeline of a plant: rows in, through the stages, to alarms."""

"""Descriptions of processes: what is measured, in which unit and role, and the equations, if there are any."""

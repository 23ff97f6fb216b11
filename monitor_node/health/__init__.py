"""Health of a monitor: its message, contained errors, other monitors of its plants."""

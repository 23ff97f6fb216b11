"""Files of stored states and alarms."""

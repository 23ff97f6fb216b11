"""Alarms after ISA-18.2: delays, states, incidents, commands, key figures."""

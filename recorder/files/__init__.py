"""MCAP files: their writer, their reader, recovery after a crash, metadata records and ages."""

"""The recorder: what travels on the bus into a file, and out of it again to the bus, to CSV and to pictures."""

"""From messages to rows: sample checks, sequence numbers, alignment."""

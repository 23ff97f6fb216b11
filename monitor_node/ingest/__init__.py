"""From messages to rows: which samples are taken, and when a row of them is complete."""

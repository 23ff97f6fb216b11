"""Statistical process control: charts, their run lengths, and what keeps a promise of false alarms."""

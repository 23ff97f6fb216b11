"""The watch: identifies the plant's behaviour, charts what it cannot predict, and raises alarms."""

"""Work on whole recordings: inspect, cut, merge, convert, play back."""

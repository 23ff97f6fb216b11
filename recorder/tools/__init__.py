"""Work on whole recordings: inspect, cut, convert, play back."""

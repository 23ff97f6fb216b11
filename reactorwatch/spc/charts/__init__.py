"""Control charts, their run lengths, and rules on their points."""

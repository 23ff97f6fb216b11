"""Results as HTML, figures and data frames: one file for each kind of result."""

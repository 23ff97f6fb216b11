"""A diagnosis as text, as an object for JSON, and as a page with figures; pure functions that return text."""

"""A diagnosis for people and machines: sentences, an object for JSON, and a page with pictures. All of it is text."""

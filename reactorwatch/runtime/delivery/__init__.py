"""Delivery of messages in the order of their publication, without gaps."""

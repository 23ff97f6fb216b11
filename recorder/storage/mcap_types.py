"""Types of the MCAP library that appear in the tools on recordings: the library is imported in this folder alone."""

from mcap.records import Attachment, Metadata
from mcap.summary import Summary

__all__ = ["Attachment", "Metadata", "Summary"]

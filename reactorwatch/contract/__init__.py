"""The message contract: key expressions, messages and their encoding. Pure: no network and no files."""

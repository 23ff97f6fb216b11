"""The message contract: key expressions, messages and their bytes. Pure: it knows no network and no file."""

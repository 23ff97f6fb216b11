"""Results as structs whose fields are those of the JSON that commands print."""

"""The command. Thin: options in, a call, words out. The only part of this package that knows the nodes."""

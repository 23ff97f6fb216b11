"""Rules of the recorder, without I/O: rotation, retention, room for keys, the black box."""

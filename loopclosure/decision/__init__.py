"""Which frames are loops: the one decision, of a recording, of a session of a map, and of a robot's frames."""

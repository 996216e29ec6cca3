"""Reading and writing video: probe, decode in a killable child, and sources with bounded memory."""

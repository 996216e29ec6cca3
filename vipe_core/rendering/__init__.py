"""Pictures and videos of results, drawn in software: no display, no OpenGL."""

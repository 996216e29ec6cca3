"""Dense depth of every frame: plane sweep over nearby frames, checked between frames, completed along edges.

Imports nothing by itself, so that settings can be read without compiling kernels.
"""

"""From frames to poses: keyframes, tracking, global adjustment, infill (paper section 3.1).

Imports nothing by itself, so that settings can be read without torch.
"""

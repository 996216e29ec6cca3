"""The numbers that a descent decides by: the same on a CPU and, defined for their compiler, in the CUDA kernels."""

from __future__ import annotations

import torch

# Largest change of log f in one step: beyond, the linearisation says nothing.
MAX_LOG_FOCAL_STEP = 0.3
# An orthographic fisheye, the most bent of all, would be infinite; an equisolid one is near 3.
ALPHA_RANGE = (0.0, 4.0)
# A column whose curvature cancels to less than this share in the elimination of the depths has none.
MIN_CURVATURE = 1e-12
# Single precision leaves errors of this size in the reduced system: less damping only makes it indefinite.
MIN_DAMPING = {torch.float32: 1e-7, torch.float64: 1e-10}
MAX_DAMPING = 1e8
ACCEPTED_FACTOR = 0.2
REJECTED_FACTOR = 10.0
# A free gauge does not couple with the focal length, so the least damping that makes the system invertible will do.
SIGMA_DAMPINGS = (1e-9, 1e-7, 1e-5)
# Mean squared residual, px^2, at which exact data is solved and only rounding is left.
NEGLIGIBLE_COST = 1e-14
# A step that is not even tried must be expected to gain less than this share of what ends the solve after it was.
UNTRIED_SHARE = 0.1
# ... and by a model that damping has not shortened much.
TRUSTED_DAMPING = 1e-2
# Graduated non-convexity divides the squared scale by this at every step.
NARROWING = 1.4

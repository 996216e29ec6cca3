"""Dense bundle adjustment: the problem, its plan, and its solvers."""

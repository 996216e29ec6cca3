"""Figures of a trajectory: seen from where it spreads most, coloured by its error, and the error over time.

Drawn with matplotlib's objects, not its global state, so that it is safe in any program and needs no display.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.errors import ConfigError
from vipe_core.evaluation.metrics import align_centres, mean_rotation, rotation_angle_deg
from vipe_core.evaluation.results import Paths
from vipe_core.formats.atomic import complete_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[Any]

_ESTIMATE, _REFERENCE, _ROTATION = "#1f5fa8", "#444444", "#c05020"


def require_matplotlib() -> None:
    """Raises:
    ConfigError: matplotlib is not installed.
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise ConfigError("plots need matplotlib; install vipe-cluster[eval], or turn plots off") from error


def plot_paths(paths: Paths, out_png: Path, title: str) -> Path:
    """Draws one sequence: the two paths from above and from the side, and position and rotation error over time.

    An estimate is aligned with the truth by a similarity, a backward run with the forward one rigidly, as the metrics
    do.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    centres, reference, apart, turned_deg = _aligned(paths)
    names = ("estimate", "ground truth") if paths.kind == "truth" else ("backward run", "forward run")
    unit = "m" if paths.kind == "truth" else "path lengths"
    across, along, up = _views(reference if np.ptp(reference, axis=0).max() > 0 else centres)

    figure = Figure(figsize=(11, 6.2), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1))
    top = figure.add_subplot(grid[0, 0])
    side = figure.add_subplot(grid[1, 0])
    shown = _path(top, centres, reference, apart, (across, along), names, unit)
    _path(side, centres, reference, apart, (across, up), names, unit)
    top.set_ylabel(f"second axis [{unit}]")
    side.set_ylabel(f"third axis [{unit}]")
    side.set_xlabel(f"axis of most spread [{unit}]")
    top.legend(loc="best", fontsize=8, framealpha=0.7)
    figure.colorbar(shown, ax=[top, side], label=f"position error [{unit}]", shrink=0.8)
    _over_time(figure.add_subplot(grid[0, 1]), paths.times_s, apart, f"position error [{unit}]", _ESTIMATE)
    _over_time(figure.add_subplot(grid[1, 1]), paths.times_s, turned_deg, "rotation error [deg]", _ROTATION)
    with complete_file(out_png) as partial:
        # No date or version inside: the same figures give the same bytes.
        figure.savefig(partial, format="png", dpi=110, metadata={"Software": None})
    return out_png


def _aligned(paths: Paths) -> tuple[Array, Array, Array, Array]:
    """Centres of the estimate in the frame of the reference, the reference's, and the errors per frame."""
    estimate, reference = paths.estimate, paths.reference
    try:
        moved = align_centres(estimate, reference, with_scale=paths.kind == "truth").apply_to_poses(estimate)
    except ValueError:  # one of them stands still
        moved = estimate.copy()
        moved[:, :3, 3] += reference[:, :3, 3].mean(axis=0) - estimate[:, :3, 3].mean(axis=0)
    centres, true = moved[:, :3, 3], reference[:, :3, 3]
    # After the best constant rotation, as the metric: a straight path does not determine the roll of the alignment.
    world = mean_rotation(estimate, reference)
    turned = np.einsum("nji,jk,nkl->nil", reference[:, :3, :3], world, estimate[:, :3, :3])
    turned_deg = rotation_angle_deg(turned)
    return centres, true, np.linalg.norm(centres - true, axis=1), turned_deg


def _views(points: Array) -> tuple[Array, Array, Array]:
    """Unit vectors along which the points spread most, less and least."""
    _, _, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=True)
    return axes[0], axes[1], axes[2]


def _path(
    axes: Axes,
    centres: Array,
    reference: Array,
    apart: Array,
    view: tuple[Array, Array],
    names: tuple[str, str],
    unit: str,
) -> Any:
    """One view of both paths; returns what a colour bar explains."""
    from matplotlib.collections import LineCollection

    middle = reference.mean(axis=0)
    flat = np.stack([(centres - middle) @ axis for axis in view], axis=1)
    true = np.stack([(reference - middle) @ axis for axis in view], axis=1)
    axes.plot(true[:, 0], true[:, 1], "--", color=_REFERENCE, linewidth=1, zorder=3, label=names[1])
    axes.plot(flat[:1, 0], flat[:1, 1], "o", color=_ESTIMATE, markersize=5, label=f"{names[0]} (dot: first frame)")
    lines = LineCollection(list(np.stack([flat[:-1], flat[1:]], axis=1)), cmap="viridis", linewidths=2)
    lines.set_array((apart[:-1] + apart[1:]) / 2)
    lines.set_clim(0, max(float(apart.max()), 1e-12))
    axes.add_collection(lines)
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    return lines


def _over_time(axes: Axes, times_s: Array, values: Array, label: str, colour: str) -> None:
    rms = float(np.sqrt(np.mean(np.square(values))))
    axes.plot(times_s, values, color=colour, linewidth=1.2)
    axes.axhline(rms, color=colour, linestyle=":", linewidth=1, label=f"RMS {rms:.3g}")
    axes.set_ylim(bottom=0)
    axes.set_xlabel("time [s]")
    axes.set_ylabel(label)
    axes.grid(alpha=0.3)
    axes.legend(loc="best", fontsize=8, framealpha=0.7)

"""What host and kernels must agree on: sizes, and the argument of every kernel.

Sizes are defined for the kernels' compiler; the argument is mirrored from `kernels/context.cu`.
"""

from __future__ import annotations

import ctypes

# Cells that a block of threads handles at a time, and in all: sums are single precision over a slice, double across.
TILE, SLICE, TILE_THREADS = 64, 256, 128
# Numbers of an edge's transform and camera, and of its twist with the steps of the intrinsics of both its cameras.
EDGE_FLOATS, TWIST_FLOATS = 20, 10
# 6x6 blocks, and scalars, of the reduced system along a tile of its factor.
SIDE_BLOCKS, SIDE = 8, 48
FACTOR_THREADS, WIDE_THREADS = 256, 256
# 6x6 blocks that a block of WIDE_THREADS works on, 36 threads each.
ASSEMBLE_BLOCKS = 7

_SIZES = (
    "num_frames num_edges num_cells width num_units num_slices num_nodes num_tail num_intrinsics num_blocks num_sides "
    "unified focal_free alpha_free robust anything_free max_iterations has_prior scratch_stride "
    "num_cameras apart num_views views_free has_view_prior num_pool"
)
_SETTINGS = (
    "stride offset robust_scale first_scale tolerance initial_damping min_damping min_depth_ratio "
    "min_depth max_depth log_focal_information components"
)
_ADDRESSES = (
    "points target_px weight prior_value prior_weight finite median largest prior_log_focal prior_view prior_sigma "
    "pose depth intrinsics view "
    "frame_cells frame_node frame_view frame_camera view_node node_view "
    "edge_id edge_source edge_target edge_transform edge_adjoint edge_twist pose_step "
    "unit_frame unit_first unit_count unit_free unit_partial unit_direct unit_eliminated "
    "partial scratch pool pool_row pool_column unit_sums "
    "block_row block_column direct_first direct_entry eliminated_first eliminated_entry diagonal_block blocks "
    "tile_row tile_column tile_first product_left product_right tile_block_first tile_block "
    "column_diagonal column_first column_tile level_column factor diagonal_factor scale solution inverse "
    "control report"
)


class Context(ctypes.Structure):
    """Passed by value to every kernel."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in _SIZES.split()),
        *((name, ctypes.c_double) for name in _SETTINGS.split()),
        *((name, ctypes.c_void_p) for name in _ADDRESSES.split()),
    )


CONTROL_BYTES = 256

CONTEXT_BYTES = ctypes.sizeof(Context)

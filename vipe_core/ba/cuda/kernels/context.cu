// What every kernel is given, and the state of the descent. Freestanding: no headers, only the compiler's built-ins.
//
// All kernels of a solve are launched one after the other on one stream, whatever becomes of it: the decisions of
// Levenberg-Marquardt are taken in `judge` and `propose`, and a kernel that has nothing to do returns at once.
// No atomics, and every sum has a fixed order, so a result has the same bits every time.

#ifndef DYNAMIC_SHARED
#define DYNAMIC_SHARED(NAME)               \
    extern __shared__ float4 NAME##_raw[]; \
    float* NAME = (float*)NAME##_raw
#endif

typedef long long i64;

// Sizes, and the numbers that the descent decides by, are defined before (`compiler.py`).
#define TILE_WARPS (TILE_THREADS / 32)
#define TINY 1.2e-38f
// Of a report, before the covariances.
#define REPORT_NUMBERS 5

// RUNNING, then as `Status` of `vipe_core/ba/problem.py`.
enum Status { RUNNING, CONVERGED, MAX_ITERATIONS, NO_PROGRESS, SINGULAR, NON_FINITE, EMPTY };
// As `CODE` of `vipe_core/ba/robust.py`; and any of them, chosen when it runs, on each component of a residual.
enum Robust { NONE, HUBER, CAUCHY, GEMAN_MCCLURE, TUKEY, TRUNCATED, COMPONENTWISE };
// What the next pass over the cells is for: nothing, the normal equations at the state, or those of a candidate.
enum Mode { IDLE, LINEARISE, STEP };

// The descent, in device memory. Costs are those of `state` at the kernel's scale of its linearisation.
struct Control {
    i64 done, status, iterations;
    i64 state, system;   // which of the two buffers holds the accepted state, and its normal equations
    i64 mode, solve;     // what to do next; whether there is a system to factorise
    i64 factorised;      // whether every pivot so far was positive
    i64 first;           // whether nothing has been judged yet
    i64 level, num_levels;  // of graduated non-convexity
    i64 covariance_found;  // of every camera
    double damping;
    double scale_system, scale_judge, scale_next;  // of the accepted linearisation, of judging and of the next one
    double lost_rho, measured, weight, lost, prior;
    double initial_cost, initial_weight;
    double predicted, first_scale;
};

// Mirrored by `context.py`; every member has eight bytes.
struct Context {
    i64 num_frames, num_edges, num_cells, width, num_units, num_slices;
    i64 num_nodes;    // free poses and views; after them comes the tail
    i64 num_tail;     // nodes of the tail: the free intrinsics of one camera after the other, then the right-hand side
    i64 num_intrinsics;  // how many of these there are
    i64 num_blocks;   // 6x6 blocks of the reduced system
    i64 num_sides;    // tiles along a side of the factor
    i64 unified, focal_free, alpha_free, robust, anything_free, max_iterations;
    i64 has_prior;
    i64 scratch_stride;  // floats of `scratch` per block
    i64 num_cameras;     // with intrinsics of their own: 1, or the views of a rig
    i64 apart;           // whether they are free, and there are several
    i64 num_views;       // of a rig; 0 without
    i64 views_free, has_view_prior;
    i64 num_pool;        // blocks of `pool` in each of its parts
    double stride, offset, robust_scale, first_scale, tolerance, initial_damping, min_damping, min_depth_ratio;
    double min_depth, max_depth, log_focal_information;
    double components;  // that the robust kernel judges each for itself: 2, or 1 where it judges their norm

    // The problem. Pixels and weights are (E, P, 2), in the order that they came in.
    const float* points;  // (N, P, 2) pixels of a frame's own instead of those of a grid, or none
    const float* target_px;
    const float* weight;
    const float* prior_value;   // (N, P)
    const float* prior_weight;
    const unsigned char* finite;  // whether state and priors are
    const float* median;          // of the inverse depths
    float* largest;               // (E) argument of the robust kernel, px^2

    const double* prior_log_focal;  // (C)
    const double* prior_view;     // (V, 16)
    const double* prior_sigma;    // (V, 2) of place and rotation

    // The state, twice: poses (2, N, 16), inverse depths (2, N, P), intrinsics (2, C, 5), cam_from_rig (2, V, 16).
    double* pose;
    float* depth;
    double* intrinsics;
    double* view;

    // Edges in order of (source, target).
    const int* frame_cells;   // (N) cells, at most P
    const int* frame_node;    // (N) node of a free pose, or -1
    const int* frame_view;    // (N) view of a rig, or 0
    const int* frame_camera;  // (N) whose intrinsics it has
    const int* view_node;     // (V) node of a free view, or -1
    const int* node_view;     // (nodes) its inverse
    const int* edge_id;
    const int* edge_source;
    const int* edge_target;
    float* edge_transform;  // (2, E, 20) rows of [R | t] and the intrinsics (5) of the target, as the state
    double* edge_adjoint;   // (E, 36) where it was linearised last
    float* edge_twist;      // (E, 10) of the proposed step, then log f and alpha of the source's camera and the target's
    double* pose_step;      // (N, 6), then those of log f and alpha (C, 2)

    // Units: the edges of a frame whose depths are eliminated together, or some of a frame whose depths are held.
    const int* unit_frame;
    const int* unit_first;
    const int* unit_count;
    const int* unit_free;
    const i64* unit_partial;    // offset of its slices in `partial`
    const i64* unit_direct;     // of its first block in `pool`: (target, target), (target, source), (tail, target) of each
                                // edge, then (source, source), (tail, source), (tail, tail)
    const i64* unit_eliminated; // likewise: the lower triangle over (source, targets, tail)
    float* partial;
    float* scratch;             // rows and products of units too large for shared memory
    double* pool;               // of frames; of a rig, then what they say of poses, and of views (`turn`)
    const int* pool_row;        // (pool) frames of a block's rows and columns, or -1, of a rig
    const int* pool_column;
    double* unit_sums;          // (units, 5) cost to judge, cost at the next scale, weight, all weight, prior

    // The reduced system in blocks: where each is summed from, (first, entries); an entry is 2 * block + transposed.
    const int* block_row;
    const int* block_column;
    const int* direct_first;
    const int* direct_entry;
    const int* eliminated_first;
    const int* eliminated_entry;
    const int* diagonal_block;  // (nodes)
    double* blocks;             // (2, blocks, 2, 36) direct and eliminated, as the system

    // Its factor in tiles, sorted by the level at which their column can be eliminated.
    const int* tile_row;
    const int* tile_column;
    const int* tile_first;      // where a tile's products begin
    const int* product_left;
    const int* product_right;
    const int* tile_block_first;
    const int* tile_block;
    const int* column_diagonal; // (sides) tile of the diagonal
    const int* column_first;    // (sides + 1) where a column's tiles below the diagonal begin
    const int* column_tile;
    const int* level_column;    // columns by level
    double* factor;             // (tiles, 48, 48)
    double* diagonal_factor;    // (sides, 48, 48)
    double* scale;              // (48 sides)
    double* solution;           // (48 sides)
    double* inverse;            // (2, intrinsics) columns of the inverse of the factor's last rows

    Control* control;
    double* report;             // as `answer.py` says
};

#ifdef CONTEXT_BYTES
static_assert(sizeof(Context) == CONTEXT_BYTES, "the context and its mirror differ");
static_assert(sizeof(Control) <= CONTROL_BYTES, "the control does not fit");
#endif

__device__ inline i64 triangle(i64 row, i64 column) { return row * (row + 1) / 2 + column; }

// Free intrinsics of a camera, and rows that an edge has for them: where cameras are apart, those of its target's camera
// come before those of its source's.
__device__ inline int num_free(const Context& c) { return (int)(c.focal_free + c.alpha_free); }
__device__ inline int num_own(const Context& c) { return num_free(c) * (c.apart ? 2 : 1); }

// Scalars of an edge's product (twist, intrinsics, right-hand side) that are kept, padded to what a warp writes at once.
__device__ constexpr int product_stride(int own) { return own == 0 ? 32 : own == 1 ? 40 : own == 2 ? 48 : 72; }

// Floats that a unit leaves per slice: its products over pairs of slots, those of its edges, and two costs of priors.
__device__ inline i64 partial_size(int count, int depth_free, int own, int tail) {
    return (depth_free ? triangle(count + tail, 0) * 36 : 0) + (i64)count * product_stride(own) + 2;
}

// `final` is the scale that graduated non-convexity ends at, see `vipe_core/ba/robust.py`.
__device__ inline double robust_cost(int kernel, double scale, double final, double squared) {
    double c2 = scale * scale;
    switch (kernel) {
        case TRUNCATED: {
            const double f2 = final * final, root = sqrt(squared);
            if (root >= scale || squared * c2 <= f2 * f2) return root >= scale ? f2 : squared;
            return f2 * (root * (2 * scale - root) - f2) / (c2 - f2);
        }
        case HUBER: return squared <= c2 ? squared : 2 * scale * sqrt(squared) - c2;
        case CAUCHY: return c2 * log1p(squared / c2);
        case TUKEY: {
            double inside = 1 - squared / c2;
            inside = inside < 0 ? 0 : inside;
            return c2 / 3 * (1 - inside * inside * inside);
        }
        case GEMAN_MCCLURE: return squared * (c2 / (c2 + squared));
        default: return squared;
    }
}

// Intrinsics (5) of a frame.
__device__ inline const double* intrinsics_of(const Context& c, int state, int frame) {
    return c.intrinsics + 5 * (state * (int)c.num_cameras + c.frame_camera[frame]);
}

// The state that the pass in hand linearises.
__device__ inline i64 linearised_state(const Control& control) {
    return control.mode == STEP ? 1 - control.state : control.state;
}

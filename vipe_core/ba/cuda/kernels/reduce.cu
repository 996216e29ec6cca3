// From the slices of the units to the blocks of the reduced system, in double precision.
//
// The only place that knows how the twist of an edge follows from poses: tau = delta_target - Ad delta_source. A unit
// becomes 6x6 blocks over (source, targets, tail) in `pool`, those of a rig are taken to what is behind its frames, and
// each block of the system then sums those that the plan lists for it.

#define SIX 6

// Entry of Ad = [R, [t]x R; 0, R] of a rigid transform, rows of 4x4.
__device__ inline double adjoint(const double* pose, int row, int column) {
    if (row >= 3) return column < 3 ? 0 : pose[4 * (row - 3) + column - 3];
    if (column < 3) return pose[4 * row + column];
    const int j = (row + 1) % 3, k = (row + 2) % 3, q = column - 3;
    return pose[4 * j + 3] * pose[4 * k + q] - pose[4 * k + 3] * pose[4 * j + q];
}

// Rows of an edge's product that say something of a column of the tail, -1 for none: one, or of cameras that are apart
// up to two, those of its target and of its source.
struct OwnRows {
    int row[2];
};

__device__ inline OwnRows own_rows(const Context& c, int source_camera, int target_camera, int column) {
    const int free = num_free(c), last = SIX + num_own(c), unknowns = (int)c.num_intrinsics;
    if (column >= unknowns) return OwnRows{{column == unknowns ? last : -1, -1}};
    if (!c.apart) return OwnRows{{SIX + column, -1}};
    const int camera = column / free, k = column % free;
    return OwnRows{{camera == target_camera ? SIX + k : -1, camera == source_camera ? SIX + free + k : -1}};
}

// fold: one block of threads per unit.
extern "C" __global__ void __launch_bounds__(WIDE_THREADS, 3) fold(const Context c) {
    const Control& control = *c.control;
    if (control.done || control.mode == IDLE) return;
    const int thread = threadIdx.x, unit = blockIdx.x, own = num_own(c), right = SIX + own, tail = (int)c.num_tail;
    const int first = c.unit_first[unit], count = c.unit_count[unit], depth_free = c.unit_free[unit];
    const int products = right * (right + 1) / 2 + right, stride = product_stride(own);
    const int pairs = depth_free ? (int)triangle(count + tail, 0) : 0, source_camera = c.frame_camera[c.unit_frame[unit]];
    const i64 size = partial_size(count, depth_free, own, tail), slices = c.num_slices;
    const float* partial = c.partial + c.unit_partial[unit];
    const float* edges = partial + (i64)pairs * 36;
    const float* priors = edges + (i64)count * stride;
    const double* twists = c.edge_adjoint + (i64)first * 36;
    double* direct = c.pool + c.unit_direct[unit] * 36;
    double* eliminated = c.pool + c.unit_eliminated[unit] * 36;

    // Twists among themselves, and with the tail. Slot k of the slices is slot k + 1 here: the source comes first.
    const int lanes = WIDE_THREADS / 36, value = thread % 36;
    if (thread < lanes * 36)
        for (int k = thread / 36, i = 0, j = k; k < pairs; k += lanes, j += lanes) {
            while (j > i) j -= ++i;
            double sum = 0;
            for (i64 s = 0; s < slices; ++s) sum += (double)partial[s * size + (i64)k * 36 + value];
            eliminated[triangle(i + 1, j + 1) * 36 + value] = sum;
        }
    for (int k = thread; k < count * (1 + tail) * 36; k += WIDE_THREADS) {
        const int m = k / 36 / (1 + tail), which = k / 36 % (1 + tail), row = k % 36 / 6, column = k % 6;
        OwnRows rows{{row, -1}};
        if (which) rows = own_rows(c, source_camera, c.frame_camera[c.edge_target[first + m]], 6 * which - 6 + row);
        double sum = 0;
#pragma unroll
        for (int i = 0; i < 2; ++i) {
            const int r = rows.row[i] > column ? rows.row[i] : column, q = rows.row[i] > column ? column : rows.row[i];
            if (q < 0) continue;
            const i64 at = (i64)m * stride + triangle(r, q);
            for (i64 s = 0; s < slices; ++s) sum += (double)edges[s * size + at];
        }
        direct[((2 + tail) * m + (which ? 1 + which : 0)) * 36 + row * 6 + column] = sum;
    }
    // Costs, a warp each: to judge, at the next scale, weight, all weight, prior.
    const int warp = thread / 32, lane = thread % 32;
    if (warp < 5) {
        double sum = 0;
        for (i64 k = lane; k < (warp < 4 ? count : 2) * slices; k += 32) {
            const i64 s = k % slices, m = k / slices;
            sum += (double)(warp < 4 ? edges[s * size + m * stride + products + warp] : priors[s * size + m]);
        }
        for (int mask = 16; mask >= 1; mask /= 2) sum += __shfl_xor_sync(0xffffffffu, sum, mask);
        if (lane == 0) c.unit_sums[(i64)unit * 5 + warp] = sum;
    }
    // The tail with itself: intrinsics, and intrinsics with the right-hand side.
    double* of_source = direct + (2 + tail) * count * 36;
    for (int k = thread; k < (int)triangle(tail, 0) * 36; k += WIDE_THREADS) {
        int i = 0, j = k / 36;
        while (j > i) j -= ++i;
        const int row = 6 * i + k % 36 / 6, column = 6 * j + k % 6;
        double sum = 0;
        for (int m = 0; m < count; ++m) {
            const int target_camera = c.frame_camera[c.edge_target[first + m]];
            const OwnRows rows = own_rows(c, source_camera, target_camera, row);
            const OwnRows columns = own_rows(c, source_camera, target_camera, column);
#pragma unroll
            for (int pair = 0; pair < 4; ++pair) {
                const int a = rows.row[pair / 2], b = columns.row[pair % 2], r = a > b ? a : b, q = a > b ? b : a;
                // The right-hand side with itself is not kept.
                if (q < 0 || q == right) continue;
                for (i64 s = 0; s < slices; ++s)
                    sum += (double)edges[s * size + (i64)m * stride + triangle(r, q)];
            }
        }
        of_source[(1 + tail) * 36 + k] = sum;
    }
    __syncthreads();

    // Columns of the source: minus the sum over the edges of their columns times Ad.
    for (int k = thread; k < (count + tail) * 36; k += WIDE_THREADS) {
        const int a = k / 36, row = k % 36 / 6, column = k % 6;
        double sum = 0;
        if (a < count) {
            const double* block = direct + (2 + tail) * a * 36;
            for (int q = 0; q < 6; ++q) sum -= block[row * 6 + q] * twists[a * 36 + q * 6 + column];
            direct[((2 + tail) * a + 1) * 36 + row * 6 + column] = sum;
        } else {
            for (int m = 0; m < count; ++m) {
                const double* block = direct + ((2 + tail) * m + 2 + a - count) * 36;
                for (int q = 0; q < 6; ++q) sum -= block[row * 6 + q] * twists[m * 36 + q * 6 + column];
            }
            of_source[(1 + a - count) * 36 + row * 6 + column] = sum;
        }
        if (!depth_free) continue;
        sum = 0;
        for (int m = 0; m < count; ++m) {
            const double* block = eliminated + (m <= a ? triangle(a + 1, m + 1) : triangle(m + 1, a + 1)) * 36;
            for (int q = 0; q < 6; ++q)
                sum -= (m <= a ? block[row * 6 + q] : block[q * 6 + row]) * twists[m * 36 + q * 6 + column];
        }
        eliminated[triangle(a + 1, 0) * 36 + row * 6 + column] = sum;
    }
    __syncthreads();
    if (thread < 72) {
        const int kind = thread / 36, row = thread % 36 / 6, column = thread % 6;
        if (kind == 1 && !depth_free) return;
        double sum = 0;
        for (int m = 0; m < count; ++m) {
            const double* block = kind ? eliminated + triangle(m + 1, 0) * 36 : direct + ((2 + tail) * m + 1) * 36;
            for (int q = 0; q < 6; ++q) sum -= twists[m * 36 + q * 6 + row] * block[q * 6 + column];
        }
        (kind ? eliminated : of_source)[row * 6 + column] = sum;
    }
}

// turn: of a rig, seven blocks of the pool per block of threads, 36 threads each. The twist of a frame is
// Ad(cam_from_rig) of its pose's plus that of its view (`vipe_core/ba/rigs.py`): a block of two frames says a block of
// their poses, and one of view and pose, of pose and view, and of their views, which is as it is.
extern "C" __global__ void __launch_bounds__(WIDE_THREADS) turn(const Context c) {
    __shared__ double blocks[ASSEMBLE_BLOCKS][36], rows[ASSEMBLE_BLOCKS][36], columns[ASSEMBLE_BLOCKS][36];
    __shared__ double halves[ASSEMBLE_BLOCKS][36];
    const Control& control = *c.control;
    if (control.done || control.mode == IDLE) return;
    const int group = threadIdx.x / 36, value = threadIdx.x % 36, row = value / 6, column = value % 6;
    const i64 block = (i64)blockIdx.x * ASSEMBLE_BLOCKS + group;
    const bool inside = group < ASSEMBLE_BLOCKS && block < c.num_pool;
    if (inside) {
        const double* views = c.view + linearised_state(control) * c.num_views * 16;
        const int above = c.pool_row[block], beside = c.pool_column[block];
        blocks[group][value] = c.pool[block * 36 + value];
        rows[group][value] = above < 0 ? row == column : adjoint(views + c.frame_view[above] * 16, row, column);
        columns[group][value] = beside < 0 ? row == column : adjoint(views + c.frame_view[beside] * 16, row, column);
    }
    __syncthreads();
    if (inside) {
        double right = 0, left = 0;
        for (int k = 0; k < 6; ++k) {
            right += blocks[group][row * 6 + k] * columns[group][k * 6 + column];
            left += rows[group][k * 6 + row] * blocks[group][k * 6 + column];
        }
        halves[group][value] = right;
        if (c.views_free) {
            c.pool[(2 * c.num_pool + block) * 36 + value] = right;
            c.pool[(3 * c.num_pool + block) * 36 + value] = left;
        }
    }
    __syncthreads();
    if (!inside) return;
    double both = 0;
    for (int k = 0; k < 6; ++k) both += rows[group][k * 6 + row] * halves[group][k * 6 + column];
    c.pool[(c.num_pool + block) * 36 + value] = both;
}

// How far a view is from its prior, in standard deviations, and the derivatives by its left twist; see
// `vipe_core/ba/rigs.py`.
__device__ inline void view_prior(const Context& c, i64 state, int view, double* residual, double (*jacobian)[6]) {
    const double* now = c.view + (state * c.num_views + view) * 16;
    const double* prior = c.prior_view + view * 16;
    const double place_sigma = c.prior_sigma[2 * view], rotation_sigma = c.prior_sigma[2 * view + 1];
    double r[3][3], t[3], trace = 0;
    for (int i = 0; i < 3; ++i) {
        t[i] = now[4 * i + 3];
        for (int j = 0; j < 3; ++j) {
            r[i][j] = now[4 * i] * prior[4 * j] + now[4 * i + 1] * prior[4 * j + 1] + now[4 * i + 2] * prior[4 * j + 2];
            t[i] -= r[i][j] * prior[4 * j + 3];
        }
        trace += r[i][i];
    }
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        residual[i] = t[i] / place_sigma;
        residual[3 + i] = (r[k][j] - r[j][k]) / (2 * rotation_sigma);
        for (int q = 0; q < 3; ++q) {
            jacobian[i][q] = (i == q) / place_sigma;
            jacobian[i][3 + q] = (q == j ? t[k] : q == k ? -t[j] : 0) / place_sigma;
            jacobian[3 + i][q] = 0;
            jacobian[3 + i][3 + q] = ((i == q) * trace - r[i][q]) / (2 * rotation_sigma);
        }
    }
}

// By how much the prior of a camera's log f is more than it.
__device__ inline double log_focal_off(const Context& c, i64 state, int camera) {
    return c.prior_log_focal[camera] - log(c.intrinsics[5 * (state * c.num_cameras + camera)]);
}

// assemble: seven blocks of the system per block of threads, 36 threads each.
extern "C" __global__ void __launch_bounds__(WIDE_THREADS) assemble(const Context c) {
    const Control& control = *c.control;
    if (control.done || control.mode == IDLE) return;
    const int value = threadIdx.x % 36, row = value / 6, column = value % 6;
    const i64 block = (i64)blockIdx.x * ASSEMBLE_BLOCKS + threadIdx.x / 36;
    if (threadIdx.x >= 36 * ASSEMBLE_BLOCKS || block >= c.num_blocks) return;
    const int flipped = column * 6 + row;
    double direct = 0, eliminated = 0;
    for (int k = c.direct_first[block]; k < c.direct_first[block + 1]; ++k) {
        const int entry = c.direct_entry[k];
        direct += c.pool[(i64)(entry / 2) * 36 + (entry % 2 ? flipped : value)];
    }
    for (int k = c.eliminated_first[block]; k < c.eliminated_first[block + 1]; ++k) {
        const int entry = c.eliminated_entry[k];
        eliminated += c.pool[(i64)(entry / 2) * 36 + (entry % 2 ? flipped : value)];
    }
    if (c.log_focal_information > 0 && c.block_column[block] >= c.num_nodes) {
        const int each = num_free(c), right = (int)c.num_intrinsics;
        const int i = (int)(c.block_row[block] - c.num_nodes) * 6 + row;
        const int j = (int)(c.block_column[block] - c.num_nodes) * 6 + column, least = i < j ? i : j;
        // The first of a camera's intrinsics, with itself or with the right-hand side.
        if (least < right && least % each == 0 && (i == j || i == right || j == right))
            direct += c.log_focal_information * (i == j ? 1 : log_focal_off(c, linearised_state(control), least / each));
    }
    if (c.has_view_prior && c.block_column[block] < c.num_nodes) {
        const int view = c.node_view[c.block_column[block]];
        const bool diagonal = c.block_row[block] == c.block_column[block];
        if (view >= 0 && (diagonal || (c.block_row[block] - c.num_nodes) * 6 + row == c.num_intrinsics)) {
            double residual[6], jacobian[6][6];
            view_prior(c, linearised_state(control), view, residual, jacobian);
            for (int k = 0; k < 6; ++k) direct += jacobian[k][column] * (diagonal ? jacobian[k][row] : -residual[k]);
        }
    }
    double* out = c.blocks + ((1 - control.system) * c.num_blocks + block) * 72;
    out[value] = direct;
    out[36 + value] = eliminated;
}

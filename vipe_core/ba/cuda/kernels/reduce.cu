// From the slices of the units to the blocks of the reduced system, in double precision.
//
// The only place that knows how the twist of an edge follows from poses: tau = delta_target - Ad delta_source. A unit
// becomes 6x6 blocks over (source, targets, tail) in `pool`, and each block of the system then sums those that the
// plan lists for it.

#define SIX 6

// fold: one block of threads per unit.
extern "C" __global__ void __launch_bounds__(WIDE_THREADS) fold(const Context c) {
    const Control& control = *c.control;
    if (control.done || control.mode == IDLE) return;
    const int thread = threadIdx.x, unit = blockIdx.x, intrinsics = num_free(c), right = SIX + intrinsics;
    const int first = c.unit_first[unit], count = c.unit_count[unit], depth_free = c.unit_free[unit];
    const int products = right * (right + 1) / 2 + right, stride = product_stride(intrinsics);
    const i64 size = partial_size(count, depth_free, intrinsics), slices = c.num_slices;
    const float* partial = c.partial + c.unit_partial[unit];
    const float* edges = partial + (depth_free ? triangle(count + 1, 0) * 36 : 0);
    const float* priors = edges + (i64)count * stride;
    const double* adjoint = c.edge_adjoint + (i64)first * 36;
    double* direct = c.pool + c.unit_direct[unit] * 36;
    double* eliminated = c.pool + c.unit_eliminated[unit] * 36;

    // Twists among themselves, and with the tail. Slot k of the slices is slot k + 1 here: the source comes first.
    const int lanes = WIDE_THREADS / 36, value = thread % 36;
    if (depth_free && thread < lanes * 36)
        for (int k = thread / 36, i = 0, j = k; k < (int)triangle(count + 1, 0); k += lanes, j += lanes) {
            while (j > i) j -= ++i;
            double sum = 0;
            for (i64 s = 0; s < slices; ++s) sum += (double)partial[s * size + (i64)k * 36 + value];
            eliminated[triangle(i + 1, j + 1) * 36 + value] = sum;
        }
    for (int k = thread; k < count * 72; k += WIDE_THREADS) {
        const int m = k / 72, tail = k % 72 / 36, row = k % 36 / 6, column = k % 6;
        double sum = 0;
        if (tail == 0 || row <= intrinsics) {
            const int r = tail ? SIX + row : row > column ? row : column, q = tail || row > column ? column : row;
            const i64 at = (i64)m * stride + triangle(r, q);
            for (i64 s = 0; s < slices; ++s) sum += (double)edges[s * size + at];
        }
        direct[(3 * m + (tail ? 2 : 0)) * 36 + row * 6 + column] = sum;
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
    double* corner = direct + (3 * count + 2) * 36;
    if (thread < 36) {
        const int row = thread / 6, column = thread % 6;
        const int r = row > column ? row : column, q = row > column ? column : row;
        double sum = 0;
        if (r <= intrinsics && q < intrinsics)
            for (int m = 0; m < count; ++m)
                for (i64 s = 0; s < slices; ++s)
                    sum += (double)edges[s * size + (i64)m * stride + triangle(SIX + r, SIX + q)];
        corner[thread] = sum;
    }
    __syncthreads();

    // Columns of the source: minus the sum over the edges of their columns times Ad.
    for (int k = thread; k < (count + 1) * 36; k += WIDE_THREADS) {
        const int a = k / 36, row = k % 36 / 6, column = k % 6;
        double sum = 0;
        if (a < count) {
            for (int q = 0; q < 6; ++q) sum -= direct[3 * a * 36 + row * 6 + q] * adjoint[a * 36 + q * 6 + column];
            direct[(3 * a + 1) * 36 + row * 6 + column] = sum;
        } else {
            for (int m = 0; m < count; ++m)
                for (int q = 0; q < 6; ++q)
                    sum -= direct[(3 * m + 2) * 36 + row * 6 + q] * adjoint[m * 36 + q * 6 + column];
            direct[(3 * count + 1) * 36 + row * 6 + column] = sum;
        }
        if (!depth_free) continue;
        sum = 0;
        for (int m = 0; m < count; ++m) {
            const double* block = eliminated + (m <= a ? triangle(a + 1, m + 1) : triangle(m + 1, a + 1)) * 36;
            for (int q = 0; q < 6; ++q)
                sum -= (m <= a ? block[row * 6 + q] : block[q * 6 + row]) * adjoint[m * 36 + q * 6 + column];
        }
        eliminated[triangle(a + 1, 0) * 36 + row * 6 + column] = sum;
    }
    __syncthreads();
    if (thread < 72) {
        const int kind = thread / 36, row = thread % 36 / 6, column = thread % 6;
        if (kind == 1 && !depth_free) return;
        double sum = 0;
        for (int m = 0; m < count; ++m) {
            const double* block = kind ? eliminated + triangle(m + 1, 0) * 36 : direct + (3 * m + 1) * 36;
            for (int q = 0; q < 6; ++q) sum -= adjoint[m * 36 + q * 6 + row] * block[q * 6 + column];
        }
        (kind ? eliminated : direct + 3 * count * 36)[row * 6 + column] = sum;
    }
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
    if (c.log_focal_information > 0 && c.block_row[block] == c.num_nodes && c.block_column[block] == c.num_nodes) {
        const int right = num_free(c);
        const double off = c.log_focal - log(c.intrinsics[5 * linearised_state(control)]);
        if (value == 0) direct += c.log_focal_information;
        if (value == right || value == right * 6) direct += c.log_focal_information * off;
    }
    double* out = c.blocks + ((1 - control.system) * c.num_blocks + block) * 72;
    out[value] = direct;
    out[36 + value] = eliminated;
}

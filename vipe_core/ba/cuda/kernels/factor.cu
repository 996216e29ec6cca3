// Cholesky factor of the damped reduced system, in tiles that follow its sparsity.
//
// The system is scaled to a unit diagonal and damped. Its right-hand side is a last row, which elimination turns into
// the forward substitution. Columns of tiles are taken by levels: those of one level do not depend on each other, and
// every tile first gathers what the columns before subtract from it, so no two blocks of threads write the same tile.
//
// `covariance` is 0 within the descent; 1, 2, ... factorise for the covariance of the intrinsics, by the least of several
// dampings at which that is possible.

__device__ inline double damping_of(const Control& control, int covariance) {
    const double of_covariance[] = {SIGMA_DAMPINGS};
    return covariance == 0 ? control.damping : of_covariance[covariance - 1];
}

__device__ inline bool nothing_to_factorise(const Control& control, int covariance) {
    if (covariance) return control.status == NON_FINITE || control.status == EMPTY || control.covariance_found;
    return control.done || !control.solve;
}

// damp: one block of threads per tile.
extern "C" __global__ void __launch_bounds__(FACTOR_THREADS) damp(const Context c, int covariance) {
    const Control& control = *c.control;
    if (nothing_to_factorise(control, covariance)) return;
    __shared__ double row_scale[SIDE], column_scale[SIDE];
    const int thread = threadIdx.x, tile = blockIdx.x, row_side = c.tile_row[tile], column_side = c.tile_column[tile];
    const double damping = damping_of(control, covariance), shrink = 1 / (1 + damping);
    const int columns = (int)(6 * c.num_nodes + c.num_intrinsics);
    const double* blocks = c.blocks + control.system * c.num_blocks * 72;
    double* out = c.factor + (i64)tile * SIDE * SIDE;
    for (int k = thread; k < SIDE * SIDE; k += FACTOR_THREADS) out[k] = 0;
    if (thread < 2 * SIDE) {
        const bool is_row = thread < SIDE;
        const int at = (is_row ? row_side : column_side) * SIDE + thread % SIDE;
        double scale = 0;
        if (at < columns) {
            const double* diagonal = blocks + (i64)c.diagonal_block[at / 6] * 72 + at % 6 * 7;
            const double curvature = diagonal[0] - shrink * diagonal[36];
            // Without any curvature there is no gradient either: scaled to a unit row, it does not move.
            scale = curvature > MIN_CURVATURE * diagonal[0] ? 1 / sqrt(curvature) : 0;
        } else if (at == columns) {
            scale = 1;
        }
        (is_row ? row_scale : column_scale)[thread % SIDE] = scale;
        if (is_row && row_side == column_side) c.scale[at] = at < columns ? scale : 0;
    }
    __syncthreads();
    const int value = thread % 36, lanes = FACTOR_THREADS / 36;
    if (thread >= lanes * 36) return;
    for (int k = c.tile_block_first[tile] + thread / 36; k < c.tile_block_first[tile + 1]; k += lanes) {
        const int block = c.tile_block[k];
        const int row = c.block_row[block] % SIDE_BLOCKS * 6 + value / 6;
        const int column = c.block_column[block] % SIDE_BLOCKS * 6 + value % 6;
        const double* entry = blocks + (i64)block * 72 + value;
        double scaled = (entry[0] - shrink * entry[36]) * row_scale[row] * column_scale[column];
        if (row_side == column_side && row == column) scaled += damping + (row_scale[row] > 0 ? 0.0 : 1.0);
        out[row * SIDE + column] = scaled;
    }
}

// gather: subtract from a tile the products of the tiles before it, one block of threads per tile of a level.
extern "C" __global__ void __launch_bounds__(FACTOR_THREADS) gather(const Context c, int covariance, int first_tile) {
    if (nothing_to_factorise(*c.control, covariance)) return;
    __shared__ double left[SIDE][SIDE + 1], right[SIDE][SIDE + 1];
    const int thread = threadIdx.x, tile = first_tile + blockIdx.x, row = thread / 16, column = thread % 16;
    if (c.tile_first[tile] == c.tile_first[tile + 1]) return;
    double sum[3][3] = {};
    for (int k = c.tile_first[tile]; k < c.tile_first[tile + 1]; ++k) {
        const double* a = c.factor + (i64)c.product_left[k] * SIDE * SIDE;
        const double* b = c.factor + (i64)c.product_right[k] * SIDE * SIDE;
        for (int e = thread; e < SIDE * SIDE; e += FACTOR_THREADS) {
            left[e / SIDE][e % SIDE] = a[e];
            right[e / SIDE][e % SIDE] = b[e];
        }
        __syncthreads();
        for (int q = 0; q < SIDE; ++q) {
#pragma unroll
            for (int i = 0; i < 3; ++i)
#pragma unroll
                for (int j = 0; j < 3; ++j) sum[i][j] += left[row + 16 * i][q] * right[column + 16 * j][q];
        }
        __syncthreads();
    }
    double* out = c.factor + (i64)tile * SIDE * SIDE;
#pragma unroll
    for (int i = 0; i < 3; ++i)
#pragma unroll
        for (int j = 0; j < 3; ++j) out[(row + 16 * i) * SIDE + column + 16 * j] -= sum[i][j];
}

// factorise: a tile of a level times the inverse of its column's factor, which every block of threads makes for itself.
extern "C" __global__ void __launch_bounds__(FACTOR_THREADS) factorise(const Context c, int covariance, int first_tile) {
    Control& control = *c.control;
    if (nothing_to_factorise(control, covariance)) return;
    __shared__ double both[2 * SIDE][SIDE + 1], pivots[2 * SIDE];
    const int thread = threadIdx.x, tile = first_tile + blockIdx.x, side = c.tile_column[tile];
    const bool diagonal = c.tile_row[tile] == side;
    const int rows = diagonal ? SIDE : 2 * SIDE;
    const int left = (int)(6 * c.num_nodes + c.num_intrinsics) - side * SIDE, columns = left < SIDE ? left : SIDE;
    const double* upper = c.factor + (i64)c.column_diagonal[side] * SIDE * SIDE;
    double* lower = c.factor + (i64)tile * SIDE * SIDE;
    for (int e = thread; e < SIDE * SIDE; e += FACTOR_THREADS) {
        both[e / SIDE][e % SIDE] = upper[e];
        if (!diagonal) both[SIDE + e / SIDE][e % SIDE] = lower[e];
    }
    bool positive = true;
    for (int k = 0; k < columns; ++k) {
        __syncthreads();
        const double pivot = both[k][k];
        positive = positive && pivot > 0;
        const double inverse = 1 / sqrt(pivot);
        if (thread < rows) pivots[thread] = thread < k ? 0 : both[thread][k] * inverse;
        __syncthreads();
        if (thread < rows && thread >= k) both[thread][k] = pivots[thread];
        for (int row = k + 1 + thread / 16; row < rows; row += FACTOR_THREADS / 16)
            for (int column = k + 1 + thread % 16; column < SIDE; column += 16)
                both[row][column] -= pivots[row] * pivots[column];
    }
    __syncthreads();
    if (diagonal && thread == 0 && !positive) control.factorised = 0;
    double* out = diagonal ? c.diagonal_factor + (i64)side * SIDE * SIDE : lower;
    for (int e = thread; e < SIDE * SIDE; e += FACTOR_THREADS) out[e] = both[(diagonal ? 0 : SIDE) + e / SIDE][e % SIDE];
}

// substitute: backwards, one block of threads per column of tiles of a level.
extern "C" __global__ void __launch_bounds__(FACTOR_THREADS) substitute(const Context c, int first_column) {
    const Control& control = *c.control;
    if (nothing_to_factorise(control, 0) || !control.factorised) return;
    const int groups = FACTOR_THREADS / SIDE;
    __shared__ double sums[FACTOR_THREADS / SIDE][SIDE], rest[SIDE], found[SIDE];
    const int thread = threadIdx.x, side = c.level_column[first_column + blockIdx.x];
    const int group = thread / SIDE, column = thread % SIDE;
    const int total = (int)(6 * c.num_nodes + c.num_intrinsics), left = total - side * SIDE;
    const int columns = left < SIDE ? left : SIDE, last = total / SIDE, right = total % SIDE;
    const double* diagonal = c.diagonal_factor + (i64)side * SIDE * SIDE;
    if (group < groups) {
        double sum = 0;
        for (int k = c.column_first[side]; k < c.column_first[side + 1]; ++k) {
            const int tile = c.column_tile[k], row_side = c.tile_row[tile];
            const double* entries = c.factor + (i64)tile * SIDE * SIDE;
            const double* solved = c.solution + (i64)row_side * SIDE;
            for (int row = group; row < SIDE; row += groups) {
                if (row_side == last && row == right) sum -= entries[row * SIDE + column];
                sum += entries[row * SIDE + column] * solved[row];
            }
        }
        sums[group][column] = sum;
    }
    __syncthreads();
    if (thread < SIDE) {
        double sum = side == last ? diagonal[right * SIDE + column] : 0;
        for (int g = 0; g < groups; ++g) sum -= sums[g][column];
        rest[column] = sum;
    }
    for (int k = columns - 1; k >= 0; --k) {
        __syncthreads();
        if (thread == k) found[k] = rest[k] / diagonal[k * SIDE + k];
        __syncthreads();
        if (thread < k) rest[thread] -= diagonal[k * SIDE + thread] * found[k];
    }
    __syncthreads();
    if (thread < SIDE) c.solution[(i64)side * SIDE + thread] = thread < columns ? found[thread] : 0;
}

// The pass over the cells: finish the proposed step, then the cost and normal equations of what it leads to.
//
// One block takes a slice of the cells of a unit, `TILE` at a time; a warp takes edges, a lane two cells. What an edge
// says of its own twist is summed in registers and reduced over the lanes by exchange of halves. What eliminating the
// depths subtracts is a matrix times itself: the rows of all edges of a tile are laid out in shared memory, and
// threads take pairs of slots (six rows of an edge, or the tail: intrinsics and right-hand side).
//
// The step of a depth needs the rows of the previous linearisation. They are made again from the measurements, which
// this pass reads anyway, and are never stored.

// Numbers a unit of `count` edges needs for the rows and the products of a tile.
struct TileLayout {
    int slots, pairs, groups, stride, items;
    __device__ TileLayout(int count, int depth_free, int tail) {
        slots = depth_free ? count + tail : 0;
        pairs = slots * (slots + 1) / 2;
        // Several threads share a pair where there are few: a power of two, at most one per four cells.
        groups = 1;
        while (groups < TILE / 4 && 2 * groups * pairs <= TILE_THREADS) groups *= 2;
        // Rows end on different banks.
        stride = TILE + (groups < 8 ? 4 * groups : 0);
        items = pairs * groups;
    }
    __device__ i64 rows() const { return (i64)6 * slots * stride; }
    __device__ i64 products() const { return (i64)36 * items; }
};

#define FIXED_FLOATS (20 + MAX_RAY_ROWS * TILE + 2 * TILE + TILE_WARPS * 4 * TILE)

// Sum v[OFFSET ... OFFSET + N) over the lanes of a warp, N a power of two; lane l is left with number l % N. Recursive,
// since an array stays in registers only where every index is known to the compiler.
template <int OFFSET, int N, int SIZE, int HALF = N / 2>
__device__ inline float exchange_halves(float (&v)[SIZE], int lane) {
    if constexpr (HALF >= 1) {
        const bool upper = (lane & HALF) != 0;
#pragma unroll
        for (int i = 0; i < HALF; ++i) {
            float sent = upper ? v[OFFSET + i] : v[OFFSET + i + HALF];
            float kept = upper ? v[OFFSET + i + HALF] : v[OFFSET + i];
            v[OFFSET + i] = kept + __shfl_xor_sync(0xffffffffu, sent, HALF);
        }
        return exchange_halves<OFFSET, N, SIZE, HALF / 2>(v, lane);
    } else {
        float total = v[OFFSET];
#pragma unroll
        for (int mask = N; mask < 32; mask *= 2) total += __shfl_xor_sync(0xffffffffu, total, mask);
        return total;
    }
}

// Products of the rows of two slots over the cells of a tile that belong to one item.
__device__ inline void multiply(const float* rows, const TileLayout& at, int item, float* products) {
    int pair = item / at.groups, group = item % at.groups;
    int i = (int)((sqrtf(8.0f * (float)pair + 1.0f) - 1.0f) * 0.5f);
    while ((i + 1) * (i + 2) / 2 <= pair) ++i;
    while (i * (i + 1) / 2 > pair) --i;
    int j = pair - i * (i + 1) / 2;
    const float* left = rows + i * at.stride;
    const float* right = rows + j * at.stride;
    const int step = at.slots * at.stride;
    float sum[36];
#pragma unroll
    for (int k = 0; k < 36; ++k) sum[k] = 0.0f;
    for (int p = 4 * group; p < TILE; p += 4 * at.groups) {
        float4 b[6];
#pragma unroll
        for (int k = 0; k < 6; ++k) b[k] = *(const float4*)(right + k * step + p);
#pragma unroll
        for (int r = 0; r < 6; ++r) {
            float4 a = *(const float4*)(left + r * step + p);
#pragma unroll
            for (int k = 0; k < 6; ++k)
                sum[6 * r + k] += a.x * b[k].x + a.y * b[k].y + a.z * b[k].z + a.w * b[k].w;
        }
    }
#pragma unroll
    for (int k = 0; k < 36; ++k) products[k * at.items + item] += sum[k];
}

// LARGE units keep rows and products in `scratch`: slower, with the same bits. Where cameras are APART, an edge has rows
// for the intrinsics of its target's camera, then of its source's; with the depths, those of the same camera are summed.
template <bool UNIFIED, bool FOCAL, bool ALPHA, bool APART, bool POINTS, int ROBUST, bool LARGE>
__device__ inline void tile_pass(const Context& c, int first_unit, float* shared) {
    constexpr int INTRINSICS = FOCAL + ALPHA, TWIST = 6, SOURCE = TWIST + (APART ? INTRINSICS : 0);
    constexpr int RIGHT = SOURCE + INTRINSICS;
    constexpr int PRODUCTS = RIGHT * (RIGHT + 1) / 2 + RIGHT;  // lower triangle without its last corner
    constexpr int STRIDE = product_stride(RIGHT - TWIST);
    const Control& control = *c.control;
    if (control.done || control.mode == IDLE) return;
    const bool step = control.mode == STEP;
    const i64 now = control.state, next = linearised_state(control), P = c.num_cells;
    const int thread = threadIdx.x, warp = thread / 32, lane = thread % 32;
    const int unit = first_unit + (int)(blockIdx.x / c.num_slices);
    const i64 slice = blockIdx.x % c.num_slices;
    const int frame = c.unit_frame[unit], first = c.unit_first[unit], count = c.unit_count[unit];
    const int depth_free = c.unit_free[unit];
    const i64 cells = POINTS ? c.frame_cells[frame] : P;
    const int tail_nodes = APART ? (int)c.num_tail : 1, unknowns = APART ? (int)c.num_intrinsics : INTRINSICS;
    const TileLayout at(count, depth_free, tail_nodes);

    double* cameras = (double*)shared;  // (2, 5) intrinsics of the frame before and after the step
    float* rays = shared + 20;
    float* depths = rays + MAX_RAY_ROWS * TILE;
    float* root_q = depths + TILE;
    float* tails = root_q + TILE;  // (warps, 4, TILE)
    float* rows = shared + FIXED_FLOATS;
    if (LARGE)
        rows = c.scratch + (i64)blockIdx.x * c.scratch_stride;
    float* products = rows + at.rows();
    float* edges = products + at.products();  // (count, STRIDE)
    // (warps, intrinsics of all cameras, TILE) where cameras are apart
    float* by_camera = edges + (i64)count * STRIDE + (i64)warp * unknowns * TILE;
    for (i64 k = thread; k < at.products() + (i64)count * STRIDE; k += TILE_THREADS) products[k] = 0.0f;

    if (thread < 5) {
        cameras[thread] = intrinsics_of(c, (int)now, frame)[thread];
        cameras[5 + thread] = intrinsics_of(c, (int)next, frame)[thread];
    }
    const Scale scale_now = scale_from(control.scale_system, c.robust_scale);
    const Scale scale_judge = scale_from(control.scale_judge, c.robust_scale);
    const Scale scale_next = scale_from(control.scale_next, c.robust_scale);
    const bool one_scale = scale_judge.c == scale_next.c;
    const float grown = 1.0f + (float)control.damping;
    float prior_cost = 0.0f;

    const i64 end = (slice + 1) * SLICE < cells ? (slice + 1) * SLICE : cells;
    for (i64 start = slice * SLICE; start < end; start += TILE) {
        const i64 cell = start + thread;  // of the thread that keeps a cell's sums
        const bool keeper = thread < TILE, real = keeper && cell < cells;
        float prior_value = 0.0f, prior_weight = 0.0f, depth = 0.0f;
        __syncthreads();  // nobody reads the previous tile any more
        if (keeper) {
            const i64 near = cell < cells ? cell : cells - 1;
            depth = c.depth[(now * c.num_frames + frame) * P + near];
            depths[thread] = depth;
            if (depth_free && c.has_prior && real) {
                prior_weight = c.prior_weight[(i64)frame * P + cell];
                prior_value = prior_weight > 0.0f ? c.prior_value[(i64)frame * P + cell] : depth;
            }
            fill_rays<UNIFIED, FOCAL, ALPHA, POINTS>(c, cameras + (step && depth_free ? 0 : 5), frame, near, thread,
                                                     rays);
        }
        __syncthreads();

        if (step && depth_free) {
            float curvature[2] = {0.0f, 0.0f}, left[2] = {0.0f, 0.0f};
            for (int m = warp; m < count; m += TILE_WARPS) {
                const i64 edge = first + m, row = (i64)c.edge_id[edge] * P;
                const float* transform = c.edge_transform + (now * c.num_edges + edge) * EDGE_FLOATS;
                const Camera before = camera_of(transform);
                const float* twist = c.edge_twist + edge * TWIST_FLOATS;
#pragma unroll
                for (int h = 0; h < 2; ++h) {
                    const int p = lane + 32 * h;
                    const bool inside = start + p < cells;
                    const i64 at_cell = row + (inside ? start + p : cells - 1);
                    View view = see<UNIFIED, FOCAL, ALPHA>(before, transform, rays, p, depths[p],
                                                           ((const float2*)c.target_px)[at_cell],
                                                           ((const float2*)c.weight)[at_cell], inside);
                    reweigh<ROBUST>((int)c.robust, scale_now, view);
                    const ByPoint j = by_point<UNIFIED>(before, view);
                    const float2 d = push<UNIFIED>(j, view, transform[3], transform[7], transform[11]);
                    float x = twist[0] * depths[p] + twist[4] * view.z - twist[5] * view.y;
                    float y = twist[1] * depths[p] + twist[5] * view.x - twist[3] * view.z;
                    float z = twist[2] * depths[p] + twist[3] * view.y - twist[4] * view.x;
                    float share = 0.0f;
                    if constexpr (FOCAL) {
                        float a, b, e;
                        ray_change<UNIFIED, FOCAL, ALPHA, false>(transform, rays, p, a, b, e);
                        x += twist[6] * a;
                        y += twist[6] * b;
                        z += twist[6] * e;
                        share += twist[8];
                    }
                    if constexpr (ALPHA) {
                        float a, b, e;
                        ray_change<UNIFIED, FOCAL, ALPHA, true>(transform, rays, p, a, b, e);
                        x += twist[7] * a;
                        y += twist[7] * b;
                        z += twist[7] * e;
                        share -= twist[9] * view.norm * view.inverse;
                    }
                    float2 moved = push<UNIFIED>(j, view, x, y, z);
                    // Both camera derivatives are multiples of f (px, py).
                    moved.x += view.su * before.fx * view.px * share;
                    moved.y += view.sv * before.fy * view.py * share;
                    curvature[h] += d.x * d.x + d.y * d.y;
                    left[h] -= d.x * (view.eu + moved.x) + d.y * (view.ev + moved.y);
                }
            }
#pragma unroll
            for (int h = 0; h < 2; ++h) {
                float* sums = tails + warp * 4 * TILE + lane + 32 * h;
                sums[0] = curvature[h];
                sums[TILE] = left[h];
            }
            __syncthreads();
            if (keeper) {
                float total = prior_weight, pull = prior_weight * (prior_value - depth);
                for (int w = 0; w < TILE_WARPS; ++w) {
                    total += tails[(w * 4) * TILE + thread];
                    pull += tails[(w * 4 + 1) * TILE + thread];
                }
                depth += total > TINY ? pull / (total * grown) : 0.0f;
                // Single precision of the bounds, as the state is.
                const float median = *c.median, low = (float)c.min_depth * median, high = (float)c.max_depth * median;
                depth = depth < low ? low : depth > high ? high : depth;
                depths[thread] = depth;
                if (real) c.depth[(next * c.num_frames + frame) * P + cell] = depth;
                const i64 near = real ? cell : cells - 1;
                fill_rays<UNIFIED, FOCAL, ALPHA, POINTS>(c, cameras + 5, frame, near, thread, rays);
            }
            __syncthreads();
        }

        float tail[2][INTRINSICS + 2];  // intrinsics, right-hand side, curvature
#pragma unroll
        for (int h = 0; h < 2; ++h)
#pragma unroll
            for (int k = 0; k < INTRINSICS + 2; ++k) tail[h][k] = 0.0f;
        if (APART && depth_free)
            for (int k = lane; k < unknowns * TILE; k += 32) by_camera[k] = 0.0f;
        for (int m = warp; m < count; m += TILE_WARPS) {
            const i64 edge = first + m, row = (i64)c.edge_id[edge] * P;
            const float* transform = c.edge_transform + (next * c.num_edges + edge) * EDGE_FLOATS;
            const Camera camera = camera_of(transform);
            float* of_target = by_camera;
            if constexpr (APART) of_target += c.frame_camera[c.edge_target[edge]] * INTRINSICS * TILE;
            float sums[STRIDE];
#pragma unroll
            for (int k = 0; k < STRIDE; ++k) sums[k] = 0.0f;
#pragma unroll
            for (int h = 0; h < 2; ++h) {
                const int p = lane + 32 * h;
                const bool inside = start + p < cells;
                const i64 at_cell = row + (inside ? start + p : cells - 1);
                View view = see<UNIFIED, FOCAL, ALPHA>(camera, transform, rays, p, depths[p],
                                                       ((const float2*)c.target_px)[at_cell],
                                                       ((const float2*)c.weight)[at_cell], inside);
                const float cost = cost_of<ROBUST>((int)c.robust, scale_judge, view);
                sums[PRODUCTS] += cost;
                sums[PRODUCTS + 1] += one_scale ? cost : cost_of<ROBUST>((int)c.robust, scale_next, view);
                sums[PRODUCTS + 2] += view.weight;
                sums[PRODUCTS + 3] += view.all_weight;
                reweigh<ROBUST>((int)c.robust, scale_next, view);

                const ByPoint j = by_point<UNIFIED>(camera, view);
                const float au = j.gu * view.px, av = j.gv * view.py, d = depths[p];
                const float u0 = j.gu - au * j.hx, u1 = -au * j.hy, u2 = -au * j.hz;
                const float v0 = -av * j.hx, v1 = j.gv - av * j.hy, v2 = -av * j.hz;
                float u[RIGHT + 1], v[RIGHT + 1];
                u[0] = d * u0;
                u[1] = d * u1;
                u[2] = d * u2;
                u[3] = view.y * u2 - view.z * u1;
                u[4] = view.z * u0 - view.x * u2;
                u[5] = view.x * u1 - view.y * u0;
                v[0] = d * v0;
                v[1] = d * v1;
                v[2] = d * v2;
                v[3] = view.y * v2 - view.z * v1;
                v[4] = view.z * v0 - view.x * v2;
                v[5] = view.x * v1 - view.y * v0;
                if constexpr (FOCAL) {
                    float a, b, e;
                    ray_change<UNIFIED, FOCAL, ALPHA, false>(transform, rays, p, a, b, e);
                    u[SOURCE] = u0 * a + u1 * b + u2 * e;
                    v[SOURCE] = v0 * a + v1 * b + v2 * e;
                    const float by_u = view.su * camera.fx * view.px, by_v = view.sv * camera.fy * view.py;
                    u[TWIST] = APART ? by_u : u[TWIST] + by_u;
                    v[TWIST] = APART ? by_v : v[TWIST] + by_v;
                }
                if constexpr (ALPHA) {
                    float a, b, e;
                    const float share = view.norm * view.inverse;
                    ray_change<UNIFIED, FOCAL, ALPHA, true>(transform, rays, p, a, b, e);
                    u[RIGHT - 1] = u0 * a + u1 * b + u2 * e;
                    v[RIGHT - 1] = v0 * a + v1 * b + v2 * e;
                    const float by_u = -share * view.su * camera.fx * view.px;
                    const float by_v = -share * view.sv * camera.fy * view.py;
                    u[TWIST + FOCAL] = APART ? by_u : u[TWIST + FOCAL] + by_u;
                    v[TWIST + FOCAL] = APART ? by_v : v[TWIST + FOCAL] + by_v;
                }
                u[RIGHT] = -view.eu;
                v[RIGHT] = -view.ev;
#pragma unroll
                for (int r = 0; r <= RIGHT; ++r)
#pragma unroll
                    for (int k = 0; k <= r; ++k)
                        if (k < RIGHT) sums[r * (r + 1) / 2 + k] += u[r] * u[k] + v[r] * v[k];
                if (depth_free) {
                    const float du = u0 * transform[3] + u1 * transform[7] + u2 * transform[11];
                    const float dv = v0 * transform[3] + v1 * transform[7] + v2 * transform[11];
#pragma unroll
                    for (int r = 0; r < TWIST; ++r)
                        rows[(r * at.slots + m) * at.stride + p] = u[r] * du + v[r] * dv;
#pragma unroll
                    for (int k = 0; k <= INTRINSICS; ++k) tail[h][k] += u[SOURCE + k] * du + v[SOURCE + k] * dv;
                    if constexpr (APART) {
#pragma unroll
                        for (int k = 0; k < INTRINSICS; ++k)
                            of_target[k * TILE + p] += u[TWIST + k] * du + v[TWIST + k] * dv;
                    }
                    tail[h][INTRINSICS + 1] += du * du + dv * dv;
                }
            }
            const float whole = exchange_halves<0, 32>(sums, lane);
            edges[(i64)m * STRIDE + lane] += whole;
            if constexpr (STRIDE > 32) {
                constexpr int SECOND = STRIDE < 64 ? STRIDE - 32 : 32;
                const float rest = exchange_halves<32, SECOND>(sums, lane);
                if (lane < SECOND) edges[(i64)m * STRIDE + 32 + lane] += rest;
            }
            if constexpr (STRIDE > 64) {
                const float rest = exchange_halves<64, STRIDE - 64>(sums, lane);
                if (lane < STRIDE - 64) edges[(i64)m * STRIDE + 64 + lane] += rest;
            }
        }
        if (!depth_free) continue;

#pragma unroll
        for (int h = 0; h < 2; ++h)
#pragma unroll
            for (int k = 0; k < INTRINSICS + 2; ++k) tails[(warp * 4 + k) * TILE + lane + 32 * h] = tail[h][k];
        __syncthreads();
        if (keeper) {
            const float off = prior_value - depth;
            float total[INTRINSICS + 2];
#pragma unroll
            for (int k = 0; k < INTRINSICS + 2; ++k) total[k] = 0.0f;
            total[INTRINSICS] = real ? prior_weight * off : 0.0f;
            total[INTRINSICS + 1] = prior_weight;
            prior_cost += prior_weight > 0.0f ? prior_weight * off * off : 0.0f;
            for (int w = 0; w < TILE_WARPS; ++w)
#pragma unroll
                for (int k = 0; k < INTRINSICS + 2; ++k) total[k] += tails[(w * 4 + k) * TILE + thread];
            const float seen = total[INTRINSICS + 1];
            root_q[thread] = seen > TINY ? 1.0f / sqrtf(seen) : 0.0f;
            if constexpr (APART) {
                const int at_source = c.frame_camera[frame] * INTRINSICS;
                const float* sums = edges + (i64)count * STRIDE + thread;
                for (int k = 0; k < 6 * tail_nodes; ++k) {
                    float sum = k == unknowns ? total[INTRINSICS] : 0.0f;
                    for (int w = 0; w < (k < unknowns ? TILE_WARPS : 0); ++w) sum += sums[(w * unknowns + k) * TILE];
#pragma unroll
                    for (int i = 0; i < INTRINSICS; ++i) sum += k == at_source + i ? total[i] : 0.0f;
                    rows[(k % 6 * at.slots + count + k / 6) * at.stride + thread] = sum;
                }
            } else {
#pragma unroll
                for (int k = 0; k < 6; ++k)
                    rows[(k * at.slots + count) * at.stride + thread] = k <= INTRINSICS ? total[k] : 0.0f;
            }
        }
        __syncthreads();
        for (int row = warp; row < 6 * at.slots; row += TILE_WARPS)
#pragma unroll
            for (int h = 0; h < 2; ++h) rows[row * at.stride + lane + 32 * h] *= root_q[lane + 32 * h];
        __syncthreads();
        for (int item = thread; item < at.items; item += TILE_THREADS) multiply(rows, at, item, products);
    }
    __syncthreads();

    const i64 size = partial_size(count, depth_free, RIGHT - TWIST, tail_nodes);
    float* out = c.partial + c.unit_partial[unit] + slice * size;
    for (int k = thread; k < 36 * at.pairs; k += TILE_THREADS) {
        const int pair = k / 36, value = k % 36;
        float sum = 0.0f;
        for (int g = 0; g < at.groups; ++g) sum += products[value * at.items + pair * at.groups + g];
        out[k] = sum;
    }
    out += 36 * at.pairs;
    for (int k = thread; k < count * STRIDE; k += TILE_THREADS) out[k] = edges[k];
    out += count * STRIDE;
#pragma unroll
    for (int mask = 16; mask >= 1; mask /= 2) prior_cost += __shfl_xor_sync(0xffffffffu, prior_cost, mask);
    if (lane == 0 && warp < TILE / 32) out[warp] = prior_cost;
}

#define DEFINE_TILE_KERNEL(NAME, UNIFIED, FOCAL, ALPHA, APART, POINTS, ROBUST, LARGE, BLOCKS)               \
    extern "C" __global__ void __launch_bounds__(TILE_THREADS, BLOCKS)                                      \
        NAME(const Context context, int first_unit) {                                                       \
        DYNAMIC_SHARED(shared);                                                                             \
        tile_pass<UNIFIED, FOCAL, ALPHA, APART, POINTS, ROBUST, LARGE>(context, first_unit, shared);        \
    }

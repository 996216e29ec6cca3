// Lookup of correlations around positions: from volumes, and by products of features on the fly.
//
// Freestanding: compiled by NVRTC for one type of value, VALUE_F16 or VALUE_F32. What is computed, and the
// order of the channels, is said in correlation.py; sums are in float32 and in one order, so results are the same on
// every run. All tensors are contiguous; answers are (edges, cells, 196) of the type of value.

#if defined(VALUE_F16)
typedef unsigned short value_t;
__device__ __forceinline__ float widen(value_t bits) {
    float x;
    asm("cvt.f32.f16 %0, %1;" : "=f"(x) : "h"(bits));
    return x;
}
__device__ __forceinline__ value_t narrow(float x) {
    value_t bits;
    asm("cvt.rn.f16.f32 %0, %1;" : "=h"(bits) : "f"(x));
    return bits;
}
#else
typedef float value_t;
__device__ __forceinline__ float widen(value_t x) { return x; }
__device__ __forceinline__ value_t narrow(float x) { return x; }
#endif

#define LEVELS 4
#define SIDE 7
#define REACH (SIDE + 1)
#define WINDOW (SIDE * SIDE)
#define CHANNELS (LEVELS * WINDOW)
#define FEATURES 128
#define SCALE 0.0625f
#define FAR 1e4f
#define VOLUME_CELLS 32
#define FEATURE_CELLS 8

struct Corner {
    int x, y;
    float fx, fy;
    bool anywhere;
};

__device__ __forceinline__ Corner corner_of(float x, float y, int level) {
    const float shrink = 1.0f / (float)(1 << level);
    x *= shrink;
    y *= shrink;
    Corner corner;
    corner.anywhere = fabsf(x) < FAR && fabsf(y) < FAR;
    const float left = floorf(x), top = floorf(y);
    corner.fx = x - left;
    corner.fy = y - top;
    corner.x = corner.anywhere ? (int)left - 3 : 0;
    corner.y = corner.anywhere ? (int)top - 3 : 0;
    return corner;
}

__device__ __forceinline__ int shrunk(int length, int level) {
    const int rest = length >> level;
    return rest > 0 ? rest : 1;
}

// One thread per cell and level. Blocks of VOLUME_CELLS * LEVELS threads, one for VOLUME_CELLS of all cells of all edges.
extern "C" __global__ void __launch_bounds__(VOLUME_CELLS * LEVELS) lookup_volume(
    const value_t *__restrict__ level0, const value_t *__restrict__ level1, const value_t *__restrict__ level2,
    const value_t *__restrict__ level3, const float *__restrict__ at, value_t *__restrict__ out, long long total,
    int height, int width) {
    __shared__ value_t staged[VOLUME_CELLS * CHANNELS];
    const int lane = threadIdx.x % VOLUME_CELLS, level = threadIdx.x / VOLUME_CELLS;
    const long long first = (long long)blockIdx.x * VOLUME_CELLS;
    const long long cell = first + lane;
    value_t *mine = staged + lane * CHANNELS + level * WINDOW;
    if (cell < total) {
        const value_t *volume = level == 0 ? level0 : level == 1 ? level1 : level == 2 ? level2 : level3;
        const int rows = shrunk(height, level), columns = shrunk(width, level);
        volume += cell * (long long)(rows * columns);
        const Corner corner = corner_of(at[2 * cell], at[2 * cell + 1], level);
        float before[SIDE];
#pragma unroll
        for (int i = 0; i <= SIDE; ++i) {
            const int x = corner.x + i;
            const bool within = corner.anywhere && x >= 0 && x < columns;
            float above = 0.0f;
#pragma unroll
            for (int j = 0; j <= SIDE; ++j) {
                const int y = corner.y + j;
                const float here = within && y >= 0 && y < rows ? widen(volume[y * columns + x]) : 0.0f;
                if (j > 0) {
                    const float between = above + corner.fy * (here - above);
                    if (i > 0) {
                        mine[(i - 1) * SIDE + j - 1] = narrow(before[j - 1] + corner.fx * (between - before[j - 1]));
                    }
                    before[j - 1] = between;
                }
                above = here;
            }
        }
    }
    __syncthreads();
    const long long left = (total - first) * CHANNELS;
    const int count = left < VOLUME_CELLS * CHANNELS ? (int)left : VOLUME_CELLS * CHANNELS;
    for (int k = threadIdx.x; k < count; k += VOLUME_CELLS * LEVELS) {
        out[first * CHANNELS + k] = staged[k];
    }
}

#define VALUES_PER_VECTOR (16 / (int)sizeof(value_t))
#define VECTORS_PER_LANE (FEATURES / VALUES_PER_VECTOR / 4)

union Vector {
    uint4 whole;
    value_t values[VALUES_PER_VECTOR];
};

// One warp per cell; four lanes share the channels of one position of the window, eight such groups are a column of it.
// Blocks of 32 * FEATURE_CELLS threads, ceil(cells / FEATURE_CELLS) of them for every edge.
extern "C" __global__ void __launch_bounds__(32 * FEATURE_CELLS) lookup_features(
    const value_t *__restrict__ level0, const value_t *__restrict__ level1, const value_t *__restrict__ level2,
    const value_t *__restrict__ level3, const long long *__restrict__ source, const long long *__restrict__ target,
    const float *__restrict__ at, value_t *__restrict__ out, int height, int width) {
    __shared__ float windows[FEATURE_CELLS * REACH * REACH];
    const int cells = height * width;
    const int blocks = (cells + FEATURE_CELLS - 1) / FEATURE_CELLS;
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32, part = lane & 3, group = lane >> 2;
    const long long edge = blockIdx.x / blocks;
    const int wanted = (int)(blockIdx.x % blocks) * FEATURE_CELLS + warp;
    // A warp beyond the last cell does its work again, so that all of the block meet at the barriers.
    const int cell = wanted < cells ? wanted : cells - 1;
    const long long row = edge * cells + cell;
    float *window = windows + warp * REACH * REACH;
    float query[VECTORS_PER_LANE * VALUES_PER_VECTOR];
    const uint4 *from = reinterpret_cast<const uint4 *>(level0 + (source[edge] * cells + cell) * FEATURES);
#pragma unroll
    for (int v = 0; v < VECTORS_PER_LANE; ++v) {
        Vector vector;
        vector.whole = from[4 * v + part];
#pragma unroll
        for (int k = 0; k < VALUES_PER_VECTOR; ++k) {
            query[v * VALUES_PER_VECTOR + k] = SCALE * widen(vector.values[k]);
        }
    }
    for (int level = 0; level < LEVELS; ++level) {
        const value_t *frames = level == 0 ? level0 : level == 1 ? level1 : level == 2 ? level2 : level3;
        const int rows = shrunk(height, level), columns = shrunk(width, level);
        frames += target[edge] * (long long)(rows * columns) * FEATURES;
        const Corner corner = corner_of(at[2 * row], at[2 * row + 1], level);
        const int y = corner.y + group;
        const bool within = corner.anywhere && y >= 0 && y < rows;
        for (int i = 0; i < REACH; ++i) {
            const int x = corner.x + i;
            float sum = 0.0f;
            if (within && x >= 0 && x < columns) {
                const uint4 *there = reinterpret_cast<const uint4 *>(frames + (long long)(y * columns + x) * FEATURES);
#pragma unroll
                for (int v = 0; v < VECTORS_PER_LANE; ++v) {
                    Vector vector;
                    vector.whole = there[4 * v + part];
#pragma unroll
                    for (int k = 0; k < VALUES_PER_VECTOR; ++k) {
                        sum = fmaf(query[v * VALUES_PER_VECTOR + k], widen(vector.values[k]), sum);
                    }
                }
            }
            sum += __shfl_xor_sync(0xffffffffu, sum, 1);
            sum += __shfl_xor_sync(0xffffffffu, sum, 2);
            if (part == 0) {
                window[i * REACH + group] = sum;
            }
        }
        __syncthreads();
        for (int k = lane; k < WINDOW; k += 32) {
            const float *corners = window + k / SIDE * REACH + k % SIDE;
            const float left = corners[0] + corner.fy * (corners[1] - corners[0]);
            const float right = corners[REACH] + corner.fy * (corners[REACH + 1] - corners[REACH]);
            if (wanted < cells) {
                out[row * CHANNELS + level * WINDOW + k] = narrow(left + corner.fx * (right - left));
            }
        }
        __syncthreads();
    }
}

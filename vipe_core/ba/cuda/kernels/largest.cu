// Where graduated non-convexity begins when it begins at the largest residual.

// largest: the largest argument of the robust kernel of an edge, one block of threads per edge.
template <bool UNIFIED>
__device__ inline void largest_of_edge(const Context& c, float* rays, float* found) {
    const int thread = threadIdx.x;
    const i64 edge = blockIdx.x, P = c.num_cells, row = (i64)c.edge_id[edge] * P;
    const int source = c.edge_source[edge];
    const float* transform = c.edge_transform + edge * EDGE_FLOATS;
    const Camera camera = camera_of(transform);
    float most = 0.0f;
    for (i64 start = 0; start < P; start += TILE) {
        const bool inside = start + thread < P;
        const i64 cell = inside ? start + thread : P - 1;
        fill_rays<UNIFIED, false, false>(c, intrinsics_of(c, 0, source), cell, thread, rays);
        const View view = see<UNIFIED, false, false>(camera, transform, rays, thread,
                                                     c.depth[source * P + cell],
                                                     ((const float2*)c.target_px)[row + cell],
                                                     ((const float2*)c.weight)[row + cell], inside);
        most = view.squared > most ? view.squared : most;
    }
    found[thread] = most;
    __syncthreads();
    if (thread) return;
    for (int k = 1; k < TILE; ++k) most = found[k] > most ? found[k] : most;
    c.largest[edge] = most;
}

extern "C" __global__ void __launch_bounds__(TILE) largest(const Context c) {
    __shared__ float rays[MAX_RAY_ROWS * TILE], found[TILE];
    if (c.unified) largest_of_edge<true>(c, rays, found);
    else largest_of_edge<false>(c, rays, found);
}

// Where graduated non-convexity begins when it begins at the largest residual.

// largest: the largest argument of the robust kernel of an edge, one block of threads per edge.
template <bool UNIFIED, bool POINTS>
__device__ inline void largest_of_edge(const Context& c, float* rays, float* found) {
    const int thread = threadIdx.x;
    const i64 edge = blockIdx.x, P = c.num_cells, row = (i64)c.edge_id[edge] * P;
    const int source = c.edge_source[edge], cells = c.frame_cells[source];
    const float* transform = c.edge_transform + edge * EDGE_FLOATS;
    const Camera camera = camera_of(transform);
    float most = 0.0f;
    for (i64 start = 0; start < cells; start += TILE) {
        const bool inside = start + thread < cells;
        const i64 cell = inside ? start + thread : cells - 1;
        fill_rays<UNIFIED, false, false, POINTS>(c, intrinsics_of(c, 0, source), source, cell, thread, rays);
        const View view = see<UNIFIED, false, false>(camera, transform, rays, thread,
                                                     c.depth[source * P + cell],
                                                     ((const float2*)c.target_px)[row + cell],
                                                     ((const float2*)c.weight)[row + cell], inside);
        float squared = view.squared;
        if (c.components > 1) squared = squared_u(view) > squared_v(view) ? squared_u(view) : squared_v(view);
        most = squared > most ? squared : most;
    }
    found[thread] = most;
    __syncthreads();
    if (thread) return;
    for (int k = 1; k < TILE; ++k) most = found[k] > most ? found[k] : most;
    c.largest[edge] = most;
}

extern "C" __global__ void __launch_bounds__(TILE) largest(const Context c) {
    __shared__ float rays[MAX_RAY_ROWS * TILE], found[TILE];
    if (c.unified && c.points) largest_of_edge<true, true>(c, rays, found);
    else if (c.unified) largest_of_edge<true, false>(c, rays, found);
    else if (c.points) largest_of_edge<false, true>(c, rays, found);
    else largest_of_edge<false, false>(c, rays, found);
}

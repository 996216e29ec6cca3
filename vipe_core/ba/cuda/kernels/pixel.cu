// One cell seen by one edge: ray, projection, robust weight and derivatives, in single precision.
//
// Unified model: s = z + alpha |X|, pixel = f (x, y) / s + c; pinhole is alpha = 0 with rays of z = 1. See
// `vipe_core/cameras/projection.py` for its rays and their derivatives, `vipe_core/ba/torch_solver.py` for the algebra.

struct Camera {
    float fx, fy, cx, cy, alpha;
};

// The camera that an edge's points are seen with, beside its transform.
__device__ inline Camera camera_of(const float* transform) {
    return Camera{transform[12], transform[13], transform[14], transform[15], transform[16]};
}

// Rows of the rays in shared memory: x, y[, z], least s, then the derivatives by log f and alpha.
template <bool UNIFIED, bool FOCAL, bool ALPHA>
struct Rays {
    static constexpr int LEAST = UNIFIED ? 3 : 2;
    static constexpr int BY_FOCAL = LEAST + 1;
    static constexpr int BY_ALPHA = BY_FOCAL + (UNIFIED && FOCAL ? 3 : 0);
    static constexpr int ROWS = BY_ALPHA + (UNIFIED && ALPHA ? 3 : 0);
};
#define MAX_RAY_ROWS 10

// Fill the rays of a tile of a frame with intrinsics k; thread p < TILE does cell p.
template <bool UNIFIED, bool FOCAL, bool ALPHA, bool POINTS>
__device__ inline void fill_rays(const Context& c, const double* k, int frame, i64 cell, int p, float* rays) {
    using R = Rays<UNIFIED, FOCAL, ALPHA>;
    float mx, my;
    if constexpr (POINTS) {
        const float2 px = ((const float2*)c.points)[frame * c.num_cells + cell];
        mx = (float)(px.x - k[2]) / (float)k[0];
        my = (float)(px.y - k[3]) / (float)k[1];
    } else {
        const int width = (int)c.width;
        mx = ((float)((int)cell % width) * (float)c.stride + (float)(c.offset - k[2])) / (float)k[0];
        my = ((float)((int)cell / width) * (float)c.stride + (float)(c.offset - k[3])) / (float)k[1];
    }
    if constexpr (!UNIFIED) {
        rays[p] = mx;
        rays[TILE + p] = my;
        rays[R::LEAST * TILE + p] = (float)c.min_depth_ratio;
    } else {
        float alpha = (float)k[4], r2 = mx * mx + my * my, bend = 1.0f - alpha * alpha, squared = 1.0f + bend * r2;
        bool on_disk = squared > 1e-6f;
        float g = sqrtf(on_disk ? squared : 1e-6f), share = 1.0f / (1.0f + r2), eta = (alpha + g) * share;
        rays[p] = eta * mx;
        rays[TILE + p] = eta * my;
        rays[2 * TILE + p] = eta - alpha;
        // The ray has unit length, so s starts at eta.
        rays[R::LEAST * TILE + p] = on_disk && eta > 0.0f ? (float)c.min_depth_ratio * eta : 3.4e38f;
        if constexpr (FOCAL) {
            float slope = (2.0f * r2 * eta - bend * r2 / g) * share;
            rays[R::BY_FOCAL * TILE + p] = (slope - eta) * mx;
            rays[(R::BY_FOCAL + 1) * TILE + p] = (slope - eta) * my;
            rays[(R::BY_FOCAL + 2) * TILE + p] = slope;
        }
        if constexpr (ALPHA) {
            float slope = (1.0f - alpha * r2 / g) * share;
            rays[R::BY_ALPHA * TILE + p] = slope * mx;
            rays[(R::BY_ALPHA + 1) * TILE + p] = slope * my;
            rays[(R::BY_ALPHA + 2) * TILE + p] = slope - 1.0f;
        }
    }
}

struct View {
    float x, y, z, inverse, px, py, norm;  // homogeneous point, 1 / s, (x, y) / s, |X|
    float eu, ev, su, sv;                  // weighted residual, roots of the weights; zero where not imaged
    float squared, weight, all_weight;     // argument of the robust kernel, larger weight where imaged and at all
};

// Where a cell with a ray and an inverse depth is seen. `inside` is false for what pads the last tile.
template <bool UNIFIED, bool FOCAL, bool ALPHA>
__device__ inline View see(const Camera& camera, const float* transform, const float* rays, int p, float depth,
                           float2 target, float2 weight, bool inside) {
    using R = Rays<UNIFIED, FOCAL, ALPHA>;
    View view;
    float a = rays[p], b = rays[TILE + p], least = rays[R::LEAST * TILE + p], s;
    bool imaged;
    if constexpr (UNIFIED) {
        float c = rays[2 * TILE + p];
        view.x = transform[0] * a + transform[1] * b + transform[2] * c + transform[3] * depth;
        view.y = transform[4] * a + transform[5] * b + transform[6] * c + transform[7] * depth;
        view.z = transform[8] * a + transform[9] * b + transform[10] * c + transform[11] * depth;
        view.norm = sqrtf(view.x * view.x + view.y * view.y + view.z * view.z);
        s = view.z + camera.alpha * view.norm;
        imaged = s > least && camera.alpha * view.z + view.norm > 0.0f;
    } else {
        view.x = transform[0] * a + transform[1] * b + transform[2] + transform[3] * depth;
        view.y = transform[4] * a + transform[5] * b + transform[6] + transform[7] * depth;
        view.z = transform[8] * a + transform[9] * b + transform[10] + transform[11] * depth;
        view.norm = 1.0f;
        s = view.z;
        imaged = s > least;
    }
    float wu = inside ? weight.x : 0.0f, wv = inside ? weight.y : 0.0f;
    wu = wu < 0.0f ? 0.0f : wu;
    wv = wv < 0.0f ? 0.0f : wv;
    view.inverse = 1.0f / (imaged ? s : 1.0f);
    view.norm = imaged ? view.norm : 1.0f;
    view.px = view.x * view.inverse;
    view.py = view.y * view.inverse;
    // A component without weight has no say, whatever it holds.
    float eu = wu > 0.0f ? camera.fx * view.px + camera.cx - target.x : 0.0f;
    float ev = wv > 0.0f ? camera.fy * view.py + camera.cy - target.y : 0.0f;
    // Written so that a weight that is not a number stays one.
    view.all_weight = wu > wv ? wu : wv == wv ? (wu == wu ? wv : wu) : wv;
    wu = imaged ? wu : 0.0f;
    wv = imaged ? wv : 0.0f;
    view.weight = imaged ? view.all_weight : 0.0f;
    view.su = sqrtf(wu);
    view.sv = sqrtf(wv);
    view.eu = imaged ? eu * view.su : 0.0f;
    view.ev = imaged ? ev * view.sv : 0.0f;
    view.squared = (view.eu * view.eu + view.ev * view.ev) / (view.weight > 1e-37f ? view.weight : 1e-37f);
    return view;
}

// A robust kernel: its scale, and the square of the one that graduated non-convexity ends at.
struct Scale {
    float c, c2, final2;
};

__device__ inline Scale scale_from(double c, double final) {
    return Scale{(float)c, (float)c * (float)c, (float)final * (float)final};
}

// Of the truncated kernel, see `vipe_core/ba/robust.py`: whether s is below all truncation, and over how much it sets in.
__device__ inline bool is_inlier(const Scale& scale, float s) {
    return s * scale.c2 <= scale.final2 * scale.final2;
}

__device__ inline float width(const Scale& scale) {
    const float wide = scale.c2 - scale.final2;
    return wide > TINY ? wide : TINY;
}

template <int ROBUST>
__device__ inline float rho(const Scale& scale, float s) {
    const float c2 = scale.c2;
    if constexpr (ROBUST == HUBER) return s > c2 ? 2.0f * scale.c * sqrtf(s) - c2 : s;
    if constexpr (ROBUST == CAUCHY) return c2 * log1pf(s / c2);
    if constexpr (ROBUST == GEMAN_MCCLURE) return s * c2 / (c2 + s);
    if constexpr (ROBUST == TUKEY) {
        float inside = 1.0f - s / c2;
        inside = inside < 0.0f ? s - s : inside;  // not a number where s is not finite
        return c2 / 3.0f * (1.0f - inside * inside * inside);
    }
    if constexpr (ROBUST == TRUNCATED) {
        const float root = sqrtf(s), least = scale.final2 / c2;
        float share = (root * (2.0f * scale.c - root) - scale.final2) / width(scale);
        share = share < least ? least : share > 1.0f ? 1.0f : share;
        share = root < scale.c ? share : 1.0f + (root - root);  // not a number where s is not finite
        return is_inlier(scale, s) ? s : scale.final2 * share;
    }
    return s;
}

// sqrt(rho'(s)).
template <int ROBUST>
__device__ inline float root_slope(const Scale& scale, float s) {
    const float c2 = scale.c2;
    if constexpr (ROBUST == HUBER) return sqrtf(sqrtf(c2 / (s > c2 ? s : c2)));
    if constexpr (ROBUST == CAUCHY) return 1.0f / sqrtf(1.0f + s / c2);
    if constexpr (ROBUST == GEMAN_MCCLURE) return c2 / (c2 + s);
    if constexpr (ROBUST == TUKEY) {
        const float root = 1.0f - s / c2;
        return root < 0.0f ? 0.0f : root;
    }
    if constexpr (ROBUST == TRUNCATED) {
        const float r = sqrtf(s), wide = width(scale), most = wide / scale.c;
        float gap = scale.c - r;
        gap = gap < 0.0f ? 0.0f : gap > most ? most : gap;
        return is_inlier(scale, s) ? 1.0f : sqrtf(scale.final2 * (gap / wide) / r);
    }
    return 1.0f;
}

// Squares of the components of a residual, px^2.
__device__ inline float squared_u(const View& view) {
    const float weight = view.su * view.su;
    return view.eu * view.eu / (weight > 1e-37f ? weight : 1e-37f);
}

__device__ inline float squared_v(const View& view) {
    const float weight = view.sv * view.sv;
    return view.ev * view.ev / (weight > 1e-37f ? weight : 1e-37f);
}

// Both by a kernel that is known when it runs.
__device__ inline float rho_of(int kernel, const Scale& scale, float s) {
    switch (kernel) {
        case HUBER: return rho<HUBER>(scale, s);
        case CAUCHY: return rho<CAUCHY>(scale, s);
        case GEMAN_MCCLURE: return rho<GEMAN_MCCLURE>(scale, s);
        case TUKEY: return rho<TUKEY>(scale, s);
        case TRUNCATED: return rho<TRUNCATED>(scale, s);
        default: return s;
    }
}

__device__ inline float root_slope_of(int kernel, const Scale& scale, float s) {
    switch (kernel) {
        case HUBER: return root_slope<HUBER>(scale, s);
        case CAUCHY: return root_slope<CAUCHY>(scale, s);
        case GEMAN_MCCLURE: return root_slope<GEMAN_MCCLURE>(scale, s);
        case TUKEY: return root_slope<TUKEY>(scale, s);
        case TRUNCATED: return root_slope<TRUNCATED>(scale, s);
        default: return 1.0f;
    }
}

// Robust cost of a cell.
template <int ROBUST>
__device__ inline float cost_of(int kernel, const Scale& scale, const View& view) {
    if constexpr (ROBUST == COMPONENTWISE)
        return view.su * view.su * rho_of(kernel, scale, squared_u(view)) +
               view.sv * view.sv * rho_of(kernel, scale, squared_v(view));
    return view.weight * rho<ROBUST>(scale, view.squared);
}

// Scale residuals and roots of weights by sqrt(rho'(s)).
template <int ROBUST>
__device__ inline void reweigh(int kernel, const Scale& scale, View& view) {
    if constexpr (ROBUST == NONE) return;
    float by_u, by_v;
    if constexpr (ROBUST == COMPONENTWISE) {
        by_u = root_slope_of(kernel, scale, squared_u(view));
        by_v = root_slope_of(kernel, scale, squared_v(view));
    } else {
        by_u = by_v = root_slope<ROBUST>(scale, view.squared);
    }
    view.eu *= by_u;
    view.ev *= by_v;
    view.su *= by_u;
    view.sv *= by_v;
}

// Derivatives of the pixel by the point, scaled: J_X = g (1 - (px, py) slope^T), slope = e_z + alpha X / |X|.
struct ByPoint {
    float gu, gv, hx, hy, hz;
};

template <bool UNIFIED>
__device__ inline ByPoint by_point(const Camera& camera, const View& view) {
    float bend = UNIFIED ? camera.alpha / view.norm : 0.0f;
    return ByPoint{view.su * camera.fx * view.inverse, view.sv * camera.fy * view.inverse, bend * view.x,
                   bend * view.y, 1.0f + bend * view.z};
}

// How a direction in space moves the scaled pixel.
template <bool UNIFIED>
__device__ inline float2 push(const ByPoint& j, const View& view, float x, float y, float z) {
    float slope = UNIFIED ? j.hx * x + j.hy * y + j.hz * z : z;
    return float2{j.gu * (x - view.px * slope), j.gv * (y - view.py * slope)};
}

// Derivative of a cell's homogeneous point by an intrinsic (row of the rays), times a step.
template <bool UNIFIED, bool FOCAL, bool ALPHA, bool BY_ALPHA>
__device__ inline void ray_change(const float* transform, const float* rays, int p, float& x, float& y, float& z) {
    using R = Rays<UNIFIED, FOCAL, ALPHA>;
    float a, b, c = 0.0f;
    if constexpr (UNIFIED) {
        const int row = BY_ALPHA ? R::BY_ALPHA : R::BY_FOCAL;
        a = rays[row * TILE + p];
        b = rays[(row + 1) * TILE + p];
        c = rays[(row + 2) * TILE + p];
    } else {
        a = -rays[p];
        b = -rays[TILE + p];
    }
    x = transform[0] * a + transform[1] * b + transform[2] * c;
    y = transform[4] * a + transform[5] * b + transform[6] * c;
    z = transform[8] * a + transform[9] * b + transform[10] * c;
}

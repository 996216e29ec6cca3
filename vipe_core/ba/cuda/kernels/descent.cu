// Levenberg-Marquardt: what is accepted, what is tried next, and when it ends. See `vipe_core/ba/levenberg.py`, whose
// rules these are. Single blocks of threads decide, everything is read and written in device memory.

__device__ inline bool is_finite(double x) { return x - x == 0; }

__device__ inline double scale_of(const Context& c, const Control& control, i64 level) {
    if (level >= control.num_levels) return c.robust_scale;
    const double span = 2 * log(control.first_scale / c.robust_scale);
    return c.robust_scale * exp(span / 2 * (double)(control.num_levels - level) / (double)control.num_levels);
}

__device__ inline void widen_damping(const Context& c, Control& control, double factor) {
    const double damping = control.damping * factor;
    control.damping = damping > c.min_damping ? damping : c.min_damping;
}

// Judge by the kernel that the state was just linearised with, whose cost is given.
__device__ inline void judge_at(const Context& c, Control& control, double measured, double weight, double lost,
                                double prior) {
    control.scale_system = control.scale_next;
    control.measured = measured;
    control.weight = weight;
    control.lost = lost;
    control.prior = prior;
    // A lost measurement costs as much as a gross outlier, else losing them all would be best.
    const double scale = control.scale_next, mean = 4 * measured / weight;
    const double outlier = c.components * robust_cost((int)c.robust, scale, c.robust_scale, 100 * scale * scale);
    control.lost_rho = outlier > mean ? outlier : mean;
}

// After a step was tried, or was not worth trying: `status` where there is a reason to stop.
__device__ inline void end_of_try(const Context& c, Control& control, i64 status, bool accepted) {
    const bool spent = control.iterations >= c.max_iterations;
    if (control.level < control.num_levels) {
        if (!accepted && !status && !spent) return;
        control.level = spent ? control.num_levels : control.level + 1;
        if (!accepted) {
            control.mode = LINEARISE;
            control.solve = 0;
            control.scale_judge = control.scale_next = scale_of(c, control, control.level);
            return;
        }
        status = 0;
    }
    if (!status && spent) status = MAX_ITERATIONS;
    if (status) {
        control.done = 1;
        control.status = status;
    }
}

// Graduated non-convexity from a scale; none where it is no wider than the kernel's own.
__device__ inline void begin_at(const Context& c, Control& control, double first) {
    control.first_scale = first;
    control.num_levels = 0;
    if (c.robust != NONE && first > c.robust_scale && is_finite(first)) {
        const double wanted = ceil(2 * log(first / c.robust_scale) / log(NARROWING));
        const double most = c.max_iterations / 2 > 1 ? (double)(c.max_iterations / 2) : 1.0;
        control.num_levels = (i64)(wanted < most ? wanted : most);
    }
    control.scale_next = scale_of(c, control, 0);
}

// begin: one thread.
extern "C" __global__ void begin(const Context c) {
    Control& control = *c.control;
    control.done = control.status = control.iterations = control.state = control.system = 0;
    control.solve = control.level = control.num_levels = control.covariance_found = 0;
    control.mode = LINEARISE;
    control.first = control.factorised = 1;
    control.damping = c.initial_damping;
    control.initial_cost = control.measured = control.weight = control.lost = control.prior = control.predicted = 0;
    control.initial_weight = 0;
    // Until `covariance` knows better.
    for (int k = 0; k < 4 * c.num_cameras; ++k) c.report[REPORT_NUMBERS + k] = sqrt(-1.0);
    control.lost_rho = 0;
    control.scale_system = control.scale_judge = c.robust_scale;
    begin_at(c, control, c.first_scale);
}

// widen: one block of threads. Begins graduated non-convexity at the largest residual.
extern "C" __global__ void __launch_bounds__(WIDE_THREADS) widen(const Context c) {
    __shared__ float shared[WIDE_THREADS];
    const int thread = threadIdx.x;
    float most = 0;
    for (i64 edge = thread; edge < c.num_edges; edge += WIDE_THREADS)
        most = c.largest[edge] > most ? c.largest[edge] : most;
    shared[thread] = most;
    __syncthreads();
    if (thread) return;
    for (int k = 1; k < WIDE_THREADS; ++k) most = shared[k] > most ? shared[k] : most;
    // Geman-McClure with squared scale mu c^2 is convex where s < mu c^2 / 3; mu c^2 = 2 max s is where to begin.
    begin_at(c, *c.control, sqrt(2.0 * (double)most));
}

// transform: edges of the state that is to be linearised, and the twists of the step that leads there.
extern "C" __global__ void __launch_bounds__(WIDE_THREADS) transform(const Context c) {
    const Control& control = *c.control;
    const i64 edge = (i64)blockIdx.x * WIDE_THREADS + threadIdx.x;
    if (control.done || control.mode == IDLE || edge >= c.num_edges) return;
    const i64 next = linearised_state(control);
    const i64 source = c.edge_source[edge], target = c.edge_target[edge];
    double r[9], t[3];
    for (int pass = control.mode == STEP ? 0 : 1; pass < 2; ++pass) {
        const i64 state = pass ? next : control.state;
        const double* s = c.pose + (state * c.num_frames + source) * 16;
        const double* g = c.pose + (state * c.num_frames + target) * 16;
        for (int i = 0; i < 3; ++i) {
            t[i] = g[4 * i + 3];
            for (int j = 0; j < 3; ++j) {
                r[3 * i + j] = g[4 * i] * s[4 * j] + g[4 * i + 1] * s[4 * j + 1] + g[4 * i + 2] * s[4 * j + 2];
                t[i] -= r[3 * i + j] * s[4 * j + 3];
            }
        }
        if (pass) break;
        // tau = delta_target - Ad delta_source, Ad = [R, [t]x R; 0, R].
        const double* a = c.pose_step + source * 6;
        const double* b = c.pose_step + target * 6;
        double linear[3], angular[3];
        for (int i = 0; i < 3; ++i) {
            linear[i] = r[3 * i] * a[0] + r[3 * i + 1] * a[1] + r[3 * i + 2] * a[2];
            angular[i] = r[3 * i] * a[3] + r[3 * i + 1] * a[4] + r[3 * i + 2] * a[5];
        }
        float* twist = c.edge_twist + edge * TWIST_FLOATS;
        for (int i = 0; i < 3; ++i) {
            const int j = (i + 1) % 3, k = (i + 2) % 3;
            twist[i] = (float)(b[i] - linear[i] - (t[j] * angular[k] - t[k] * angular[j]));
            twist[3 + i] = (float)(b[3 + i] - angular[i]);
        }
        const double* cameras = c.pose_step + c.num_frames * 6;
        for (int k = 0; k < 2; ++k) {
            twist[6 + k] = (float)cameras[2 * c.frame_camera[source] + k];
            twist[8 + k] = (float)cameras[2 * c.frame_camera[target] + k];
        }
    }
    float* out = c.edge_transform + (next * c.num_edges + edge) * EDGE_FLOATS;
    const double* camera = intrinsics_of(c, (int)next, (int)target);
    for (int k = 0; k < 5; ++k) out[12 + k] = (float)camera[k];
    double* twists = c.edge_adjoint + edge * 36;
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        out[4 * i + 3] = (float)t[i];
        for (int q = 0; q < 3; ++q) {
            out[4 * i + q] = (float)r[3 * i + q];
            twists[i * 6 + q] = twists[(3 + i) * 6 + 3 + q] = r[3 * i + q];
            twists[i * 6 + 3 + q] = t[j] * r[3 * k + q] - t[k] * r[3 * j + q];
            twists[(3 + i) * 6 + q] = 0;
        }
    }
}

// Sums over `WIDE_THREADS` threads in a fixed order; all threads get them.
template <int N>
__device__ inline void sum_threads(double (&value)[N], double* shared) {
    const int thread = threadIdx.x;
    for (int k = 0; k < N; ++k) {
        shared[thread] = value[k];
        __syncthreads();
        for (int half = WIDE_THREADS / 2; half >= 1; half /= 2) {
            if (thread < half) shared[thread] += shared[thread + half];
            __syncthreads();
        }
        value[k] = shared[0];
        __syncthreads();
    }
}

// judge: one block of threads. Whether the candidate is accepted, and what to do next.
extern "C" __global__ void __launch_bounds__(WIDE_THREADS, 1) judge(const Context c) {
    __shared__ double shared[WIDE_THREADS];
    Control& control = *c.control;
    const int thread = threadIdx.x;
    double sums[5] = {0, 0, 0, 0, 0};
    for (i64 unit = thread; unit < c.num_units; unit += WIDE_THREADS)
        for (int k = 0; k < 5; ++k) sums[k] += c.unit_sums[unit * 5 + k];
    sum_threads(sums, shared);
    if (thread) return;
    control.factorised = 1;
    if (control.done || control.mode == IDLE) return;
    const double measured = sums[0], next = sums[1], weight = sums[2], lost = sums[3] - sums[2];
    double prior = sums[4];
    for (int camera = 0; camera < (c.log_focal_information > 0 ? c.num_cameras : 0); ++camera) {
        const double off = log_focal_off(c, linearised_state(control), camera);
        prior += c.log_focal_information * off * off;
    }
    for (int view = 0; view < (c.has_view_prior ? c.num_views : 0); ++view) {
        double residual[6], jacobian[6][6];
        view_prior(c, linearised_state(control), view, residual, jacobian);
        for (int k = 0; k < 6; ++k) prior += residual[k] * residual[k];
    }
    if (control.mode == LINEARISE) {
        judge_at(c, control, next, weight, lost, prior);
        control.system = 1 - control.system;
        control.solve = 1;
        if (control.first) {
            control.first = 0;
            control.initial_cost = measured;
            control.initial_weight = weight;
            if (!*c.finite || !is_finite(measured) || !is_finite(weight)) control.status = NON_FINITE;
            else if (!c.anything_free || !(weight > 0)) control.status = EMPTY;
            control.done = control.status != RUNNING;
            if (control.done) {
                control.measured = measured;
                return;
            }
        }
        if (control.iterations >= c.max_iterations) {
            if (control.level < control.num_levels) end_of_try(c, control, 0, false);
            else end_of_try(c, control, 0, true);
        }
        return;
    }
    const double total = control.measured + control.prior + control.lost_rho * control.lost;
    const double new_total = measured + prior + control.lost_rho * lost;
    const bool better = new_total < total;
    const double gain = better ? total - new_total : control.predicted;
    const bool solved = gain < c.tolerance * total || (better && new_total < NEGLIGIBLE_COST * weight);
    if (better) {
        control.state = 1 - control.state;
        control.system = 1 - control.system;
        widen_damping(c, control, ACCEPTED_FACTOR);
        if (control.scale_next == control.scale_judge) {
            control.measured = measured;
            control.weight = weight;
            control.lost = lost;
            control.prior = prior;
        } else {
            judge_at(c, control, next, weight, lost, prior);
        }
    } else {
        widen_damping(c, control, REJECTED_FACTOR);
    }
    end_of_try(c, control, solved ? CONVERGED : control.damping > MAX_DAMPING ? NO_PROGRESS : RUNNING, better);
}

// exp(twist) pose, both (translation, rotation) from the left; what does not move keeps its bits.
__device__ inline void move_pose(const double* twist, const double* pose, double* out) {
    bool moves = false;
    for (int k = 0; k < 6; ++k) moves = moves || twist[k] != 0;
    if (!moves) {
        for (int k = 0; k < 16; ++k) out[k] = pose[k];
        return;
    }
    const double wx = twist[3], wy = twist[4], wz = twist[5], s = wx * wx + wy * wy + wz * wz;
    double sinc, cosc, third;
    if (s < 1e-4) {
        sinc = 1 - s / 6 * (1 - s / 20 * (1 - s / 42));
        cosc = 0.5 - s / 24 * (1 - s / 30 * (1 - s / 56));
        third = 1.0 / 6 - s / 120 * (1 - s / 42 * (1 - s / 72));
    } else {
        const double angle = sqrt(s);
        sinc = sin(angle) / angle;
        cosc = (1 - cos(angle)) / s;
        third = (angle - sin(angle)) / (s * angle);
    }
    const double cross[9] = {0, -wz, wy, wz, 0, -wx, -wy, wx, 0};
    double r[9], v[9], t[3];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            double squared = 0;
            for (int k = 0; k < 3; ++k) squared += cross[3 * i + k] * cross[3 * k + j];
            r[3 * i + j] = (i == j) + sinc * cross[3 * i + j] + cosc * squared;
            v[3 * i + j] = (i == j) + cosc * cross[3 * i + j] + third * squared;
        }
    for (int i = 0; i < 3; ++i) t[i] = v[3 * i] * twist[0] + v[3 * i + 1] * twist[1] + v[3 * i + 2] * twist[2];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 4; ++j)
            out[4 * i + j] = r[3 * i] * pose[j] + r[3 * i + 1] * pose[4 + j] + r[3 * i + 2] * pose[8 + j] +
                             (j == 3 ? t[i] : 0);
    for (int j = 12; j < 16; ++j) out[j] = pose[j];
}

// The step of a pose or a view; none of what is held.
__device__ inline void node_step(const Context& c, int node, double* twist) {
    for (int k = 0; k < 6; ++k) twist[k] = node < 0 ? 0 : c.solution[node * 6 + k] * c.scale[node * 6 + k];
}

// propose: one block of threads. Whether the solution is worth a try, and the poses and intrinsics it leads to.
extern "C" __global__ void __launch_bounds__(WIDE_THREADS) propose(const Context c) {
    __shared__ double shared[WIDE_THREADS];
    __shared__ int tried;
    Control& control = *c.control;
    const int thread = threadIdx.x, each = num_free(c), right = (int)c.num_intrinsics;
    if (control.done || !control.solve) return;
    const double* blocks = c.blocks + control.system * c.num_blocks * 72;
    const double* now = c.intrinsics + 5 * c.num_cameras * control.state;
    const double shrink = 1 / (1 + control.damping);
    double* intrinsic_step = c.pose_step + c.num_frames * 6;
    const bool factorised = control.factorised != 0;
    // Everybody has read the control before anybody writes it.
    __syncthreads();
    if (thread == 0) tried = 0;
    for (i64 camera = thread; camera < c.num_cameras; camera += WIDE_THREADS) {
        const i64 at = 6 * c.num_nodes + camera * each, of_alpha = at + c.focal_free;
        double* step = intrinsic_step + 2 * camera;
        step[0] = step[1] = 0;
        if (factorised && c.focal_free) {
            const double wanted = c.solution[at] * c.scale[at];
            step[0] = wanted > MAX_LOG_FOCAL_STEP ? MAX_LOG_FOCAL_STEP
                      : wanted < -MAX_LOG_FOCAL_STEP ? -MAX_LOG_FOCAL_STEP : wanted;
        }
        if (factorised && c.alpha_free) {
            const double old = now[5 * camera + 4], alpha = old + c.solution[of_alpha] * c.scale[of_alpha];
            step[1] = (alpha > MAX_ALPHA ? MAX_ALPHA : alpha < MIN_ALPHA ? MIN_ALPHA : alpha) - old;
        }
    }
    __syncthreads();
    // Gradient times step: that of the depths follows from what their elimination leaves of the gradient.
    double predicted[1] = {0};
    if (factorised)
        for (i64 block = thread; block < c.num_blocks; block += WIDE_THREADS) {
            if (c.block_row[block] != c.num_nodes + right / 6) continue;
            const i64 column = c.block_column[block];
            const double* entry = blocks + block * 72 + right % 6 * 6;
            if (column < c.num_nodes) {
                for (int k = 0; k < 6; ++k)
                    predicted[0] += (entry[k] - shrink * entry[36 + k]) * c.solution[column * 6 + k] *
                                    c.scale[column * 6 + k];
            } else {
                const int first = (int)(column - c.num_nodes) * 6, left = right - first, count = left < 6 ? left : 6;
                for (int k = 0; k < count; ++k) {
                    const int camera = (first + k) / each, which = c.focal_free ? (first + k) % each : 1;
                    predicted[0] += (entry[k] - shrink * entry[36 + k]) * intrinsic_step[2 * camera + which];
                }
                if (left < 6) predicted[0] += shrink * entry[36 + left];
            }
        }
    sum_threads(predicted, shared);
    if (thread == 0) {
        const double total = control.measured + control.prior + control.lost_rho * control.lost;
        control.predicted = predicted[0];
        if (!factorised) {
            ++control.iterations;
            widen_damping(c, control, REJECTED_FACTOR);
            control.mode = IDLE;
            end_of_try(c, control, control.damping > MAX_DAMPING ? SINGULAR : RUNNING, false);
        } else if (predicted[0] < UNTRIED_SHARE * c.tolerance * total && control.damping <= TRUSTED_DAMPING) {
            end_of_try(c, control, CONVERGED, false);
        } else {
            ++control.iterations;
            control.mode = STEP;
            control.scale_judge = scale_of(c, control, control.level);
            control.scale_next =
                control.iterations >= c.max_iterations ? c.robust_scale : scale_of(c, control, control.level + 1);
            tried = 1;
        }
    }
    __syncthreads();
    if (!tried) return;
    double* next = c.intrinsics + 5 * c.num_cameras * (1 - control.state);
    for (i64 k = thread; k < 5 * c.num_cameras; k += WIDE_THREADS) {
        const double* step = intrinsic_step + k / 5 * 2;
        next[k] = k % 5 < 2 && c.focal_free ? now[k] * exp(step[0]) : k % 5 == 4 ? now[k] + step[1] : now[k];
    }
    const double* views = c.view + control.state * c.num_views * 16;
    for (i64 view = thread; view < c.num_views; view += WIDE_THREADS) {
        double twist[6];
        node_step(c, c.view_node[view], twist);
        move_pose(twist, views + view * 16, c.view + ((1 - control.state) * c.num_views + view) * 16);
    }
    for (i64 frame = thread; frame < c.num_frames; frame += WIDE_THREADS) {
        const double* pose = c.pose + (control.state * c.num_frames + frame) * 16;
        double* moved = c.pose + ((1 - control.state) * c.num_frames + frame) * 16;
        double* step = c.pose_step + frame * 6;
        double twist[6];
        node_step(c, c.frame_node[frame], twist);
        if (c.num_views == 0) {
            for (int k = 0; k < 6; ++k) step[k] = twist[k];
            move_pose(twist, pose, moved);
            continue;
        }
        // That of the pose as the frame sees it, then that of its view.
        const int view = c.frame_view[frame];
        double turned[6], between[16];
        for (int k = 0; k < 6; ++k) {
            turned[k] = 0;
            for (int q = 0; q < 6; ++q) turned[k] += adjoint(views + view * 16, k, q) * twist[q];
        }
        node_step(c, c.view_node[view], twist);
        for (int k = 0; k < 6; ++k) step[k] = turned[k] + twist[k];
        move_pose(turned, pose, between);
        move_pose(twist, between, moved);
    }
}

// Entry of the factor among the columns of the tail, row >= column.
__device__ inline double tail_factor(const Context& c, int row, int column) {
    const i64 i = 6 * c.num_nodes + row, j = 6 * c.num_nodes + column;
    const i64 at = i % SIDE * SIDE + j % SIDE, above = i / SIDE, side = j / SIDE;
    if (above == side) return c.diagonal_factor[side * SIDE * SIDE + at];
    int k = c.column_first[side];
    while (c.tile_row[c.column_tile[k]] != above) ++k;
    return c.factor[(i64)c.column_tile[k] * SIDE * SIDE + at];
}

// covariance: one thread. The intrinsics are eliminated last, so the last of the factor is all it takes: of L L^T, the
// inverse is M^T M with M = L^-1, and columns of M are zero above their diagonal. Each camera has the first attempt that
// says something of it.
extern "C" __global__ void covariance(const Context c, int attempt) {
    Control& control = *c.control;
    if (nothing_to_factorise(control, attempt)) return;
    const bool factorised = control.factorised != 0;
    control.factorised = control.covariance_found = 1;
    const int each = num_free(c), unknowns = (int)c.num_intrinsics, cameras = unknowns / each;
    const double* scale = c.scale + 6 * c.num_nodes;
    for (int camera = 0; camera < cameras; ++camera) {
        double* out = c.report + REPORT_NUMBERS + 4 * camera;
        if (out[0] == out[0]) continue;
        double found[2][2] = {{0, 0}, {0, 0}};
        bool sound = factorised;
        for (int k = 0; k < (sound ? each : 0); ++k) {
            double* column = c.inverse + k * unknowns;
            for (int row = camera * each; row < unknowns; ++row) {
                double sum = row == camera * each + k ? 1 : 0;
                for (int q = camera * each; q < row; ++q) sum -= tail_factor(c, row, q) * column[q];
                column[row] = sum / tail_factor(c, row, row);
            }
            for (int j = 0; j <= k; ++j) {
                double sum = 0;
                for (int row = camera * each; row < unknowns; ++row) sum += column[row] * c.inverse[j * unknowns + row];
                found[k][j] = found[j][k] = sum * scale[camera * each + k] * scale[camera * each + j];
            }
            sound = found[k][k] > 0;
        }
        if (!sound) control.covariance_found = 0;
        else if (each == 2) out[0] = found[0][0], out[1] = out[2] = found[0][1], out[3] = found[1][1];
        else out[0] = c.focal_free ? found[0][0] : 0, out[1] = out[2] = 0, out[3] = c.focal_free ? 0 : found[0][0];
    }
}

// finish: the accepted state into the first buffer, and the report (`answer.py`).
extern "C" __global__ void __launch_bounds__(WIDE_THREADS) finish(const Context c) {
    const Control& control = *c.control;
    const i64 thread = (i64)blockIdx.x * WIDE_THREADS + threadIdx.x;
    const i64 cells = c.num_frames * c.num_cells, numbers = c.num_frames * 16;
    if (control.state) {
        if (thread < cells) c.depth[thread] = c.depth[cells + thread];
        if (thread < numbers) c.pose[thread] = c.pose[numbers + thread];
        if (thread < 5 * c.num_cameras) c.intrinsics[thread] = c.intrinsics[5 * c.num_cameras + thread];
        if (thread < 16 * c.num_views) c.view[thread] = c.view[16 * c.num_views + thread];
    }
    if (thread) return;
    const double nan = sqrt(-1.0);
    // Of what is held, and where nothing was solved, there is nothing to be unsure of.
    if (control.status == NON_FINITE || control.status == EMPTY || !num_free(c))
        for (int k = 0; k < 4 * c.num_cameras; ++k) c.report[REPORT_NUMBERS + k] = 0;
    c.report[0] = (double)((control.status == RUNNING ? MAX_ITERATIONS : control.status) - CONVERGED);
    c.report[1] = (double)control.iterations;
    // Of a state that is not finite there is no cost.
    c.report[2] = *c.finite ? control.initial_cost : nan;
    c.report[3] = *c.finite ? control.measured : nan;
    c.report[4] = *c.finite ? control.weight : 0.0;
}

// Enough of CUDA to run the kernels of vipe_core/ba/cuda on a CPU, for tests: included before their source.
//
// Threads of a block are fibers on one thread. A fiber runs until a barrier, an exchange within its warp, or its end;
// which one goes next is a choice (`order`), so code that races gives other results in another order. Blocks of threads
// run one after the other, in an order that is a choice as well. Waiting at different places at once is an error, as it
// is on a GPU.
#include <setjmp.h>
#include <ucontext.h>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <vector>

struct float2 {
    float x, y;
};
struct alignas(16) float4 {
    float x, y, z, w;
};

namespace emulator {

struct Index {
    unsigned x;
};
enum State { READY, AT_BARRIER, AT_EXCHANGE, ENDED };
struct Fiber {
    ucontext_t context;
    jmp_buf resume;
    State state;
    int line;
    bool started;
    Index index;
    double exchanged;
};

static std::vector<Fiber> fibers;
static std::vector<char> stacks;
static std::vector<double> exchanged;
static Fiber* current;
static jmp_buf scheduler;
static Index block;
static float* dynamic_shared;
static std::function<void()> body;
static const size_t STACK_BYTES = 64 << 10;
static const char* failure;

static void yield(State state, int line) {
    current->state = state;
    current->line = line;
    if (!_setjmp(current->resume)) _longjmp(scheduler, 1);
}

static void entry() {
    body();
    current->state = ENDED;
    _longjmp(scheduler, 1);
}

static void barrier(int line) { yield(AT_BARRIER, line); }

template <typename T>
T exchange(unsigned mask, T value, int lanes, int line) {
    static_assert(sizeof(T) <= sizeof(double), "");
    if (mask != 0xffffffffu) failure = "exchange within a part of a warp";
    std::memcpy(&current->exchanged, &value, sizeof(T));
    const unsigned other = current->index.x ^ lanes;
    yield(AT_EXCHANGE, line);
    T answer;
    std::memcpy(&answer, &exchanged[other], sizeof(T));
    return answer;
}

static void resume(Fiber& fiber) {
    current = &fiber;
    if (_setjmp(scheduler)) return;
    if (fiber.started) _longjmp(fiber.resume, 1);
    fiber.started = true;
    setcontext(&fiber.context);
}

// Release the fibers [begin, end) if all that have not ended wait in the same way at the same place.
static bool release(unsigned begin, unsigned end, State state, bool whole) {
    int line = -1, waiting = 0;
    for (unsigned k = begin; k < end; ++k) {
        Fiber& fiber = fibers[k];
        if (fiber.state == ENDED && !whole) continue;
        if (fiber.state != state) return false;
        if (line >= 0 && fiber.line != line) {
            failure = "threads wait at different places";
            return false;
        }
        line = fiber.line;
        ++waiting;
    }
    if (!waiting) return false;
    if (state == AT_EXCHANGE)
        for (unsigned k = begin; k < end; ++k) exchanged[k] = fibers[k].exchanged;
    for (unsigned k = begin; k < end; ++k)
        if (fibers[k].state == state) fibers[k].state = READY;
    return true;
}

// Number k of n in one of three orders: forwards, backwards, or in strides of a prime that does not divide n.
static unsigned in_order(int order, unsigned k, unsigned n) {
    return order == 0 ? k : order == 1 ? n - 1 - k : (unsigned)((unsigned long long)k * (n % 37 ? 37 : 41) % n);
}

static const char* run(unsigned blocks, unsigned threads, unsigned shared_bytes, int order, std::function<void()> work) {
    const unsigned guard = 64;
    // What every GPU since compute capability 8.0 can launch.
    if (blocks < 1 || threads < 1 || threads > 1024 || shared_bytes > (99 << 10)) return "cannot be launched";
    std::vector<float4> shared(shared_bytes / sizeof(float4) + 1 + guard);
    dynamic_shared = (float*)shared.data();
    body = work;
    fibers.resize(threads);
    exchanged.resize(threads);
    stacks.resize(threads * STACK_BYTES);
    failure = nullptr;
    for (unsigned turn = 0; turn < blocks; ++turn) {
        block.x = in_order(order, turn, blocks);
        std::memset(shared.data(), 0xff, shared.size() * sizeof(float4));  // not a number
        for (unsigned k = 0; k < threads; ++k) {
            Fiber& fiber = fibers[k];
            getcontext(&fiber.context);
            fiber.context.uc_stack.ss_sp = &stacks[k * STACK_BYTES];
            fiber.context.uc_stack.ss_size = STACK_BYTES;
            fiber.context.uc_link = nullptr;
            makecontext(&fiber.context, entry, 0);
            fiber.state = READY;
            fiber.started = false;
            fiber.index.x = k;
        }
        for (unsigned ended = 0; ended < threads;) {
            for (unsigned k = 0; k < threads; ++k) {
                Fiber& fiber = fibers[in_order(order, k, threads)];
                if (fiber.state == READY) resume(fiber);
            }
            ended = 0;
            for (const Fiber& fiber : fibers) ended += fiber.state == ENDED;
            bool moved = release(0, threads, AT_BARRIER, false);
            for (unsigned warp = 0; warp + 32 <= threads; warp += 32)
                moved = release(warp, warp + 32, AT_EXCHANGE, true) || moved;
            if (!moved && ended < threads) failure = failure ? failure : "threads wait for each other";
            if (failure) return failure;
        }
        const unsigned char* after = (const unsigned char*)shared.data() + shared_bytes;
        for (unsigned k = 0; k < guard * sizeof(float4); ++k)
            if (after[k] != 0xff) return "write beyond shared memory";
    }
    return nullptr;
}

}  // namespace emulator

#define __device__
#define __global__
#define __shared__ static
#define __launch_bounds__(...)
#define DYNAMIC_SHARED(NAME) float* NAME = emulator::dynamic_shared
#define __syncthreads() emulator::barrier(__LINE__)
#define __shfl_xor_sync(MASK, VALUE, LANES) emulator::exchange(MASK, VALUE, LANES, __LINE__)
#define threadIdx (emulator::current->index)
#define blockIdx (emulator::block)

// As much of a CUDA driver as the launcher of vipe_core/ba/cuda asks for: it does nothing, and says on standard output
// what it was asked. The real bindings load it by its name and convert every argument for it.
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <string>

typedef int Result;
enum { SUCCESS = 0, INVALID_VALUE = 1, INVALID_IMAGE = 200, NOT_FOUND = 500 };
static const int MAX_DYNAMIC_SHARED = 8, SHARED_OPTIN = 97;

extern "C" {
Result cuInit(unsigned) { return SUCCESS; }
Result cuDriverGetVersion(int* version) {
    *version = 13000;
    return SUCCESS;
}
Result cuDeviceGetAttribute(int* value, int attribute, int device) {
    *value = attribute == SHARED_OPTIN ? 232448 : 0;
    return device == 3 ? SUCCESS : INVALID_VALUE;
}
Result cuLibraryLoadData(void** library, const void* code, void*, void*, unsigned, void*, void*, unsigned) {
    static int loaded;
    *library = &loaded;
    return std::memcmp(code, "\177ELF", 4) ? INVALID_IMAGE : SUCCESS;
}
Result cuLibraryUnload(void*) { return SUCCESS; }
Result cuLibraryGetKernel(void** kernel, void*, const char* name) {
    *kernel = new std::string(name);
    return SUCCESS;
}
Result cuKernelSetAttribute(int attribute, int value, void* kernel, int device) {
    std::printf("%s may have %d bytes on %d\n", ((std::string*)kernel)->c_str(), value, device);
    return attribute == MAX_DYNAMIC_SHARED ? SUCCESS : INVALID_VALUE;
}
Result cuLaunchKernel(void* kernel, unsigned x, unsigned y, unsigned z, unsigned threads, unsigned threads_y,
                      unsigned threads_z, unsigned shared_bytes, void* stream, void** parameters, void** extra) {
    if (!x || y != 1 || z != 1 || !threads || threads_y != 1 || threads_z != 1 || extra) return INVALID_VALUE;
    std::printf("%s %u x %u, %u bytes, on %llu, frames %lld, number %d\n", ((std::string*)kernel)->c_str(), x, threads,
                shared_bytes, (unsigned long long)(uintptr_t)stream, *(long long*)parameters[0], *(int*)parameters[1]);
    return SUCCESS;
}
Result cuGetProcAddress_v2(const char* name, void** function, int, uint64_t, int* found) {
    *function = nullptr;
#define OFFER(FUNCTION) \
    if (!std::strcmp(name, #FUNCTION)) *function = (void*)FUNCTION;
    OFFER(cuInit) OFFER(cuDriverGetVersion) OFFER(cuDeviceGetAttribute) OFFER(cuLibraryLoadData)
    OFFER(cuLibraryUnload) OFFER(cuLibraryGetKernel) OFFER(cuKernelSetAttribute) OFFER(cuLaunchKernel)
    if (!std::strcmp(name, "cuGetProcAddress")) *function = (void*)cuGetProcAddress_v2;
    if (found) *found = *function ? 0 : 1;
    return *function ? SUCCESS : NOT_FOUND;
}
}

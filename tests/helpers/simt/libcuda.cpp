// A library that loads as the NVIDIA driver's: it answers the one question by which cuda-bindings finds all functions of the
// driver, with those that the tests have (driver.py).
#include <cstdint>

#define EXPORT extern "C" __attribute__((visibility("default")))

EXPORT void* (*resolve)(const char*);
void* (*resolve)(const char*) = nullptr;

EXPORT int cuGetProcAddress_v2(const char* symbol, void** function, int, std::uint64_t, int* status) {
    constexpr int kNotFound = 500;
    *function = resolve ? resolve(symbol) : nullptr;
    if (status) *status = *function ? 0 : 1;
    return *function ? 0 : kNotFound;
}

// CUDA's built-in variables, types and functions in terms of simt.h: those that the kernels use.
#pragma once

#include "simt.h"

#define threadIdx (simt::machine.current->thread)
#define blockIdx (simt::machine.block)
#define blockDim (simt::machine.block_size)
#define gridDim (simt::machine.grid_size)

struct alignas(8) float2 { float x, y; };
struct float3 { float x, y, z; };
struct alignas(16) float4 { float x, y, z, w; };
struct alignas(8) int2 { int x, y; };
struct alignas(16) int4 { int x, y, z, w; };
struct alignas(8) uint2 { unsigned x, y; };
struct alignas(16) uint4 { unsigned x, y, z, w; };
struct uchar3 { unsigned char x, y, z; };
struct alignas(4) uchar4 { unsigned char x, y, z, w; };
inline float2 make_float2(float x, float y) { return {x, y}; }
inline float3 make_float3(float x, float y, float z) { return {x, y, z}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
inline int2 make_int2(int x, int y) { return {x, y}; }
inline int4 make_int4(int x, int y, int z, int w) { return {x, y, z, w}; }
inline uint2 make_uint2(unsigned x, unsigned y) { return {x, y}; }
inline uint4 make_uint4(unsigned x, unsigned y, unsigned z, unsigned w) { return {x, y, z, w}; }

// Block-wide.
inline void __syncthreads() { simt::barrier(false, "__syncthreads"); }
inline int __syncthreads_count(int p) { return simt::barrier(p != 0, "__syncthreads_count"); }
inline int __syncthreads_or(int p) { return simt::barrier(p != 0, "__syncthreads_or") != 0; }
inline int __syncthreads_and(int p) { return simt::barrier(p == 0, "__syncthreads_and") == 0; }

// Warp-wide.
namespace simt {
template <class T>
T from_lane(unsigned mask, T value, const char* operation, int source) {
    static_assert(sizeof(T) <= sizeof(uint64_t));
    uint64_t bits = 0;
    memcpy(&bits, &value, sizeof value);
    const uint64_t* values = exchange(mask, bits, operation);
    if (!(mask >> source & 1)) fail(std::string(operation) + " reads a lane outside of its mask");
    memcpy(&value, &values[source], sizeof value);
    return value;
}
inline int lane() { return static_cast<int>(machine.current->lane()); }
}  // namespace simt

inline void __syncwarp(unsigned mask = ~0u) { simt::exchange(mask, 0, "__syncwarp", true); }
template <class T>
T __shfl_sync(unsigned mask, T value, int source, int width = 32) {
    return simt::from_lane(mask, value, "__shfl_sync", (simt::lane() & ~(width - 1)) | (source & (width - 1)));
}
template <class T>
T __shfl_xor_sync(unsigned mask, T value, int bits, int width = 32) {
    const int lane = simt::lane(), source = lane ^ bits;
    return simt::from_lane(mask, value, "__shfl_xor_sync", source < (lane & ~(width - 1)) + width ? source : lane);
}
template <class T>
T __shfl_down_sync(unsigned mask, T value, unsigned delta, int width = 32) {
    const int lane = simt::lane(), in_segment = lane & (width - 1), step = static_cast<int>(delta);
    return simt::from_lane(mask, value, "__shfl_down_sync", in_segment + step < width ? lane + step : lane);
}
template <class T>
T __shfl_up_sync(unsigned mask, T value, unsigned delta, int width = 32) {
    const int lane = simt::lane(), in_segment = lane & (width - 1), step = static_cast<int>(delta);
    return simt::from_lane(mask, value, "__shfl_up_sync", in_segment >= step ? lane - step : lane);
}
inline unsigned __ballot_sync(unsigned mask, int predicate) {
    const uint64_t* values = simt::exchange(mask, predicate != 0, "__ballot_sync");
    unsigned ballot = 0;
    for (int i = 0; i < 32; ++i)
        if (mask >> i & 1) ballot |= static_cast<unsigned>(values[i]) << i;
    return ballot;
}
template <class T>
unsigned __match_any_sync(unsigned mask, T value) {
    uint64_t bits = 0;
    memcpy(&bits, &value, sizeof value);
    const uint64_t* values = simt::exchange(mask, bits, "__match_any_sync");
    unsigned equal = 0;
    for (int i = 0; i < 32; ++i)
        if (mask >> i & 1) equal |= (values[i] == bits ? 1u : 0u) << i;
    return equal;
}
inline int __any_sync(unsigned mask, int predicate) { return __ballot_sync(mask, predicate) != 0; }
inline int __all_sync(unsigned mask, int predicate) { return __ballot_sync(mask, predicate) == mask; }

// Atomics: fibers give way nowhere inside of them. They order no other memory.
template <class T, class F>
T simt_update(T* address, F&& change) {
    T old;
    __atomic_load(address, &old, __ATOMIC_RELAXED);
    T changed = change(old);
    while (!__atomic_compare_exchange(address, &old, &changed, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) changed = change(old);
    return old;
}
template <class T> T atomicAdd(T* p, T v) { return simt_update(p, [=](T old) { return static_cast<T>(old + v); }); }
template <class T> T atomicSub(T* p, T v) { return simt_update(p, [=](T old) { return static_cast<T>(old - v); }); }
template <class T> T atomicMax(T* p, T v) { return simt_update(p, [=](T old) { return old < v ? v : old; }); }
template <class T> T atomicMin(T* p, T v) { return simt_update(p, [=](T old) { return v < old ? v : old; }); }
template <class T> T atomicOr(T* p, T v) { return simt_update(p, [=](T old) { return old | v; }); }
template <class T> T atomicAnd(T* p, T v) { return simt_update(p, [=](T old) { return old & v; }); }
template <class T> T atomicExch(T* p, T v) { return simt_update(p, [=](T) { return v; }); }
template <class T> T atomicCAS(T* p, T c, T v) { return simt_update(p, [=](T old) { return old == c ? v : old; }); }
inline void __threadfence() {}
inline void __threadfence_block() {}

// Bits and numbers. The approximate functions are exact here.
template <class T> T __ldg(const T* p) { return *p; }
inline int __popc(unsigned x) { return std::popcount(x); }
inline int __ffs(int x) { return __builtin_ffs(x); }
inline int __clz(int x) { return x ? __builtin_clz(static_cast<unsigned>(x)) : 32; }
inline int __float_as_int(float x) { return std::bit_cast<int>(x); }
inline float __int_as_float(int x) { return std::bit_cast<float>(x); }
inline unsigned __float_as_uint(float x) { return std::bit_cast<unsigned>(x); }
inline float __uint_as_float(unsigned x) { return std::bit_cast<float>(x); }
inline float __expf(float x) { return std::exp(x); }
inline float __logf(float x) { return std::log(x); }
inline float __fdividef(float a, float b) { return a / b; }
inline float __frcp_rn(float a) { return 1.0f / a; }
inline float rsqrtf(float x) { return 1.0f / std::sqrt(x); }
inline float __saturatef(float x) { return x < 0 ? 0 : x > 1 ? 1 : x; }
using std::max;
using std::min;

// What the instructions of PTX compute, on the machine of simt.h: the functions that ptx.py calls, under their names there.
//
// A register is a variable of its declared type; an instruction reads and writes it as a type of its own. Addresses of
// shared memory are offsets, as on a device; all others are where the memory is.
#pragma once

#include <cfloat>
#include <concepts>
#include <limits>
#include <type_traits>

#include "simt.h"

namespace ptx {

// The bits of a register as T: its low ones where it is wider, with zeros above where it is not.
template <class T, class R>
T as(R value) {
    if constexpr (std::is_same_v<T, R>) {
        return value;
    } else if constexpr (sizeof(T) == sizeof(R) && !std::is_same_v<T, bool>) {
        return std::bit_cast<T>(value);
    } else {
        static_assert(std::integral<T> && std::integral<R>);
        return static_cast<T>(value);
    }
}

// Into a register that is as wide or wider: signed values keep their sign.
template <class R, class T>
void put(R& target, T value) {
    if constexpr (sizeof(T) == sizeof(R)) {
        target = std::bit_cast<R>(value);
    } else {
        static_assert(std::integral<T> && std::integral<R> && sizeof(T) <= sizeof(R));
        target = static_cast<R>(value);
    }
}

// Memory

template <size_t Size>
struct Local {
    alignas(16) unsigned char bytes[Size];
    Local() { memset(bytes, simt::kPoison, Size); }
};

inline uint64_t address_of(const void* pointer) { return reinterpret_cast<uintptr_t>(pointer); }

template <class T, int Count>
T* at(uint64_t address) {
    if (address % (sizeof(T) * Count) != 0)
        simt::fail("an access of " + std::to_string(sizeof(T) * Count) + " bytes at an address that they do not divide");
    return reinterpret_cast<T*>(address);
}
template <class T, int Count, size_t Size>
T* within(unsigned char (&room)[Size], uint64_t address) {
    if (const uint64_t offset = address - address_of(room); offset > Size || Size - offset < sizeof(T) * Count)
        simt::fail("an access outside of " + std::to_string(Size) + " bytes of parameters or local memory");
    return at<T, Count>(address);
}
template <class T, int Count, size_t Size>
T* within_shared(unsigned char (&room)[Size], uint32_t offset) {  // a register and the number beside it wrap
    if (offset > Size || Size - offset < sizeof(T) * Count)
        simt::fail("an access outside of " + std::to_string(Size) + " bytes of shared memory");
    return at<T, Count>(address_of(room) + offset);
}

// Arithmetic. Integers wrap; floats round each operation, and only fma joins two.

template <class T>
using Bits = std::conditional_t<sizeof(T) == 8, uint64_t, uint32_t>;  // 16 bits too: promoted, their product may not fit an int
template <class T>
concept Number = std::floating_point<T>;

template <class T> T flush(T x) { return std::fpclassify(x) == FP_SUBNORMAL ? std::copysign(T(0), x) : x; }

template <class T> T add(T a, T b) { if constexpr (Number<T>) return a + b; else return static_cast<T>(Bits<T>(a) + Bits<T>(b)); }
template <class T> T sub(T a, T b) { if constexpr (Number<T>) return a - b; else return static_cast<T>(Bits<T>(a) - Bits<T>(b)); }
template <Number T> T mul(T a, T b) { return a * b; }
template <class T> T mul_lo(T a, T b) { return static_cast<T>(Bits<T>(a) * Bits<T>(b)); }
template <class T> T mad_lo(T a, T b, T c) { return add(mul_lo(a, b), c); }
template <class T> T mul_hi(T a, T b) {
    using Wide = std::conditional_t<std::is_signed_v<T>, __int128, unsigned __int128>;
    return static_cast<T>(Wide(a) * Wide(b) >> 8 * sizeof(T));
}
inline uint32_t mul_wide(uint16_t a, uint16_t b) { return uint32_t{a} * b; }
inline int32_t mul_wide(int16_t a, int16_t b) { return int32_t{a} * b; }
inline uint64_t mul_wide(uint32_t a, uint32_t b) { return uint64_t{a} * b; }
inline int64_t mul_wide(int32_t a, int32_t b) { return int64_t{a} * b; }
template <Number T> T fma(T a, T b, T c) { return std::fma(a, b, c); }
template <class T> T div(T a, T b) {
    if constexpr (std::integral<T>)
        if (b == 0) simt::fail("an integer divided by 0");
    return a / b;
}
template <std::integral T> T rem(T a, T b) {
    if (b == 0) simt::fail("the remainder of an integer by 0");
    return a % b;
}
template <class T> T min(T a, T b) { if constexpr (Number<T>) return std::fmin(a, b); else return b < a ? b : a; }
template <class T> T max(T a, T b) { if constexpr (Number<T>) return std::fmax(a, b); else return a < b ? b : a; }
template <class T> T neg(T a) { if constexpr (Number<T>) return -a; else return static_cast<T>(0 - Bits<T>(a)); }
template <class T> T abs(T a) { if constexpr (Number<T>) return std::fabs(a); else return a < 0 ? neg(a) : a; }
template <Number T> T rcp(T a) { return 1 / a; }
template <Number T> T sqrt(T a) { return std::sqrt(a); }
template <Number T> T ex2(T a) { return std::exp2(a); }
template <Number T> T lg2(T a) { return std::log2(a); }

// Comparisons: false where a number is missing, but for those that end in u, and for equ and neu.

template <class T> bool is_eq(T a, T b) { return a == b; }
template <class T> bool is_lt(T a, T b) { return a < b; }
template <class T> bool is_le(T a, T b) { return a <= b; }
template <class T> bool is_gt(T a, T b) { return a > b; }
template <class T> bool is_ge(T a, T b) { return a >= b; }
template <class T> bool is_ne(T a, T b) { return a < b || a > b; }
template <Number T> bool is_equ(T a, T b) { return !is_ne(a, b); }
template <Number T> bool is_neu(T a, T b) { return !(a == b); }
template <Number T> bool is_ltu(T a, T b) { return !(a >= b); }
template <Number T> bool is_leu(T a, T b) { return !(a > b); }
template <Number T> bool is_gtu(T a, T b) { return !(a <= b); }
template <Number T> bool is_geu(T a, T b) { return !(a < b); }
template <class T> T selp(T a, T b, bool first) { return first ? a : b; }

// Bits

template <class T> T and_(T a, T b) { return static_cast<T>(a & b); }
template <class T> T or_(T a, T b) { return static_cast<T>(a | b); }
template <class T> T xor_(T a, T b) { return static_cast<T>(a ^ b); }
template <class T> T not_(T a) { if constexpr (std::is_same_v<T, bool>) return !a; else return static_cast<T>(~a); }
template <class T> constexpr uint32_t kWidth = 8 * sizeof(T);
template <class T> T shl(T a, uint32_t by) { return by >= kWidth<T> ? T(0) : static_cast<T>(Bits<T>(a) << by); }
template <class T> T shr(T a, uint32_t by) {
    if (by >= kWidth<T>) return std::is_signed_v<T> && a < 0 ? static_cast<T>(-1) : T(0);
    return static_cast<T>(a >> by);
}
template <class T> uint32_t popc(T a) { return static_cast<uint32_t>(std::popcount(a)); }
template <class T> uint32_t clz(T a) { return static_cast<uint32_t>(std::countl_zero(a)); }
template <class T> T brev(T a) {
    T reversed = 0;
    for (uint32_t i = 0; i < kWidth<T>; ++i) reversed = static_cast<T>(reversed << 1 | (a >> i & 1));
    return reversed;
}
template <std::unsigned_integral T> uint32_t bfind_shiftamt(T a) { return a ? static_cast<uint32_t>(std::countl_zero(a)) : ~0u; }
template <class T> T bfi(T field, T into, uint32_t place, uint32_t count) {
    place &= 255;
    count &= 255;
    const T ones = count >= kWidth<T> ? static_cast<T>(~T(0)) : static_cast<T>((T(1) << count) - 1);
    const T mask = shl(ones, place);
    return static_cast<T>((into & ~mask) | (shl(field, place) & mask));
}
inline uint32_t prmt(uint32_t a, uint32_t b, uint32_t selection) {
    const uint64_t bytes = uint64_t{b} << 32 | a;
    uint32_t result = 0;
    for (int i = 0; i < 4; ++i) {
        const uint32_t chosen = selection >> 4 * i & 15;
        const uint32_t byte = bytes >> 8 * (chosen & 7) & 255;
        result |= (chosen & 8 ? (byte & 128 ? 255u : 0u) : byte) << 8 * i;
    }
    return result;
}
inline uint32_t shf_l_wrap(uint32_t low, uint32_t high, uint32_t by) {
    return static_cast<uint32_t>((uint64_t{high} << 32 | low) << (by & 31) >> 32);
}

// Conversions. To integers numbers are clamped; NaN is 0, or for 64 bits on either side the highest bit alone.

template <class To, class From>
To cvt(From x) { return static_cast<To>(x); }
template <class To, class From>
To to_integer(From x) {
    if (x != x) return sizeof(From) == 8 || sizeof(To) == 8 ? static_cast<To>(std::make_unsigned_t<To>(1) << (kWidth<To> - 1)) : To(0);
    // the largest To may not be a From, but what is rounded is at least the power of two above it where it is above it
    if (x >= std::ldexp(From(1), static_cast<int>(kWidth<To>) - std::is_signed_v<To>)) return std::numeric_limits<To>::max();
    if (x <= static_cast<From>(std::numeric_limits<To>::min())) return std::numeric_limits<To>::min();
    return static_cast<To>(x);
}
template <class To, class From>
To rounded(From x) {
    if constexpr (Number<To>) return static_cast<To>(x);
    else return to_integer<To>(x);
}
template <class To, class From> To cvt_rn(From x) { return static_cast<To>(x); }
template <class To, Number From> To cvt_rzi(From x) { return rounded<To>(std::trunc(x)); }
template <class To, Number From> To cvt_rni(From x) { return rounded<To>(std::nearbyint(x)); }
template <class To, Number From> To cvt_rmi(From x) { return rounded<To>(std::floor(x)); }
template <class To, Number From> To cvt_rpi(From x) { return rounded<To>(std::ceil(x)); }

// Of a warp and of a block

inline bool ignored;

inline uint32_t from_lane(uint32_t value, int source, bool inside, uint32_t mask, bool& was_inside, const char* name) {
    was_inside = inside;
    return simt::from_lane(mask, value, name, inside ? source : simt::lane());
}
// `bounds`: the last lane of a segment that may be read in the low bits, which bits name the segment from bit 8 on.
struct Segment {
    int first, last;
    Segment(uint32_t bounds) {
        const int mask = static_cast<int>(bounds >> 8 & 31);
        first = simt::lane() & mask;
        last = first | (static_cast<int>(bounds & 31) & ~mask);
    }
};
inline uint32_t shfl_up(uint32_t value, uint32_t by, uint32_t bounds, uint32_t mask, bool& inside) {
    const int source = simt::lane() - static_cast<int>(by & 31);
    return from_lane(value, source, source >= Segment(bounds).last, mask, inside, "shfl.up");
}
inline uint32_t shfl_down(uint32_t value, uint32_t by, uint32_t bounds, uint32_t mask, bool& inside) {
    const int source = simt::lane() + static_cast<int>(by & 31);
    return from_lane(value, source, source <= Segment(bounds).last, mask, inside, "shfl.down");
}
inline uint32_t shfl_bfly(uint32_t value, uint32_t bits, uint32_t bounds, uint32_t mask, bool& inside) {
    const int source = simt::lane() ^ static_cast<int>(bits & 31);
    return from_lane(value, source, source <= Segment(bounds).last, mask, inside, "shfl.bfly");
}
inline uint32_t shfl_idx(uint32_t value, uint32_t lane, uint32_t bounds, uint32_t mask, bool& inside) {
    const Segment segment(bounds);
    const int source = segment.first | static_cast<int>(lane & 31 & ~(bounds >> 8));
    return from_lane(value, source, source <= segment.last, mask, inside, "shfl.idx");
}
inline uint32_t vote_ballot(bool p, uint32_t mask) { return __ballot_sync(mask, p); }
inline bool vote_any(bool p, uint32_t mask) { return __any_sync(mask, p) != 0; }
inline bool vote_all(bool p, uint32_t mask) { return __all_sync(mask, p) != 0; }
template <class T> uint32_t match_any(T value, uint32_t mask) { return __match_any_sync(mask, value); }
inline bool bar_or(bool p) { return __syncthreads_or(p) != 0; }
inline bool bar_and(bool p) { return __syncthreads_and(p) != 0; }
inline uint32_t bar_popc(bool p) { return static_cast<uint32_t>(__syncthreads_count(p)); }

template <class T> T atom_add(T* p, T v) { return atomicAdd(p, v); }
template <class T> T atom_min(T* p, T v) { return atomicMin(p, v); }
template <class T> T atom_max(T* p, T v) { return atomicMax(p, v); }
template <class T> T atom_and(T* p, T v) { return atomicAnd(p, v); }
template <class T> T atom_or(T* p, T v) { return atomicOr(p, v); }
template <class T> T atom_exch(T* p, T v) { return atomicExch(p, v); }
template <class T> T atom_cas(T* p, T expected, T v) { return atomicCAS(p, expected, v); }

// A launch: no more threads than the kernel was compiled for, and parameters as a device gets them, by value.
inline const char* launch(void (*kernel)(), size_t most, const unsigned* grid, const unsigned* block, void** arguments,
                          unsigned char* parameters, const unsigned* sizes, const unsigned* offsets) {
    if (size_t{block[0]} * block[1] * block[2] > most) return "more threads in a block than the kernel is compiled for";
    for (int i = 0; sizes[i] != 0; ++i) memcpy(parameters + offsets[i], arguments[i], sizes[i]);
    return simt::run_grid(grid, block, kernel);
}

}  // namespace ptx

#define PTX_LIST(...) {__VA_ARGS__}
#define PTX_EXPORT(kernel, most, parameters, sizes, offsets)                                                       \
    extern "C" { __attribute__((visibility("default"))) unsigned simt_parameters_##kernel[] = sizes; }             \
    extern "C" __attribute__((visibility("default"))) const char* simt_launch_##kernel(                            \
        const unsigned* grid, const unsigned* block, void** arguments, unsigned order_seed) {                      \
        static constexpr unsigned kOffsets[] = offsets;                                                            \
        simt::machine.order_seed = order_seed;                                                                     \
        return ptx::launch(kernel, most, grid, block, arguments, parameters, simt_parameters_##kernel, kOffsets);  \
    }

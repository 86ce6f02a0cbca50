// Thread pool of the CPU engine.
//
// parallel_for(n, grain, body) calls body(begin, end) on disjoint ranges that cover [0, n). Ranges are handed out
// dynamically, so a body must not depend on which thread runs it or in which order: every result has its own place
// in memory, and sums over ranges are taken afterwards in a fixed order. That is what makes images and gradients
// bit-equal for any number of threads. Nested calls run inline.
#pragma once

#include <cstdint>
#include <functional>

namespace etsplat {

using RangeBody = std::function<void(int64_t begin, int64_t end)>;

int num_threads();
void set_num_threads(int n);  // n >= 1; n == 0 means all cores this process may use

void parallel_for(int64_t n, int64_t grain, const RangeBody& body);

// Seconds spent inside parallel_for since the last reset, as wall time of the calling thread, leaving out calls too small
// to share (benchmarks/ uses it to report the serial part).
double parallel_seconds();
void reset_parallel_seconds();

}  // namespace etsplat

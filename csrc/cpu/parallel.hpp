// Two ways to share a loop among OpenMP threads. Results never depend on the number of threads as long as the bodies
// write disjoint places.
#pragma once

#include <algorithm>
#include <cstdint>

namespace dyngs {

// f(begin, end) over [0, n) in pieces of `grain`, handed out dynamically.
template <class F>
void parallel_for(int64_t n, int64_t grain, int threads, F&& f) {
  const int64_t pieces = (n + grain - 1) / grain;
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads) if (threads > 1 && pieces > 1)
  for (int64_t i = 0; i < pieces; ++i) f(i * grain, std::min(n, (i + 1) * grain));
}

// f(part, begin, end) for `parts` equal contiguous ranges of [0, n), one per thread.
template <class F>
void parallel_parts(int64_t n, int parts, F&& f) {
#pragma omp parallel for schedule(static, 1) num_threads(parts) if (parts > 1)
  for (int i = 0; i < parts; ++i) f(i, n * i / parts, n * (i + 1) / parts);
}

}  // namespace dyngs

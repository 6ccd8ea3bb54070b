// Rows of a few numbers each, as vectors that hold one number of many rows.
#pragma once

#include <algorithm>

#include "cpu/simd.hpp"

namespace dyngs {

// Rows of kWidth numbers, from row `first` on; what is missing after `count` repeats the last row.
template <int kWidth, class S, class V>
void load_lanes(const S* from, int64_t first, int count, V (&to)[kWidth]) {
  for (int i = 0; i < V::kSize; ++i) {
    const S* row = from + kWidth * (first + std::min(i, count - 1));
    for (int k = 0; k < kWidth; ++k) to[k][i] = row[k];
  }
}
template <int kWidth, class S, class V>
void store_lanes(S* to, int64_t first, int count, const V (&from)[kWidth]) {
  for (int i = 0; i < count; ++i)
    for (int k = 0; k < kWidth; ++k) to[kWidth * (first + i) + k] = from[k][i];
}

}  // namespace dyngs

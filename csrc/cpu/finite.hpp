// How many elements of an array are NaN or infinite.
#pragma once

#include <cstdint>

namespace dyngs {

template <class S>
int64_t count_nonfinite(const S* x, int64_t n, int threads);

}  // namespace dyngs

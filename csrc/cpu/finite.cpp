// Counts NaN and infinities by their exponent bits.
#include "core/api.hpp"

#include <atomic>
#include <bit>

#include "cpu/parallel.hpp"

namespace dyngs {
namespace {

inline bool is_nonfinite(float x) { return (std::bit_cast<uint32_t>(x) & 0x7f800000u) == 0x7f800000u; }
inline bool is_nonfinite(double x) { return (std::bit_cast<uint64_t>(x) & 0x7ff0000000000000u) == 0x7ff0000000000000u; }

}  // namespace

template <class S>
int64_t count_nonfinite(const S* x, int64_t n, int threads) {
  std::atomic<int64_t> total{0};  // integers: the order of the additions does not matter
  parallel_for(n, 1 << 16, threads, [&](int64_t begin, int64_t end) {
    int64_t count = 0;
    for (int64_t i = begin; i < end; ++i) count += is_nonfinite(x[i]) ? 1 : 0;
    if (count != 0) total += count;
  });
  return total;
}

template int64_t count_nonfinite<float>(const float*, int64_t, int);
template int64_t count_nonfinite<double>(const double*, int64_t, int);

}  // namespace dyngs

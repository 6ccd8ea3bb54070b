// Sums over the lanes of up to sixteen packets at a time, by a tree of adds: every level halves the number of partial sums
// of all packets and puts two packets into one. The order of the adds is the same on every instruction set.
#pragma once

#include "cpu/simd.hpp"

namespace dyngs {

#define DYNGS_PAIR_SUM(first, second) \
  return Simd<float, kCount>(__builtin_shufflevector first) + Simd<float, kCount>(__builtin_shufflevector second)

// Two packets in one. `kParts`: partial sums per number before, half as many after. Down to 8 parts those of `a` come before
// those of `b`; below that they alternate within every four lanes.
template <int kParts, int kCount>
DYNGS_INLINE Simd<float, kCount> halved(Simd<float, kCount> a, Simd<float, kCount> b) {
  if constexpr (!kInOneRegister<float, kCount>) {
    if constexpr (kParts == kCount)
      return {a.lo + a.hi, b.lo + b.hi};
    else if constexpr (kParts > 4)
      return {halved<kParts>(a.lo, a.hi), halved<kParts>(b.lo, b.hi)};
    else
      return {halved<kParts>(a.lo, b.lo), halved<kParts>(a.hi, b.hi)};
  } else if constexpr (kParts == 16) {
    DYNGS_PAIR_SUM((a.v, b.v, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23),
                   (a.v, b.v, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31));
  } else if constexpr (kParts == 8 && kCount == 16) {
    DYNGS_PAIR_SUM((a.v, b.v, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27),
                   (a.v, b.v, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31));
  } else if constexpr (kParts == 4 && kCount == 16) {
    DYNGS_PAIR_SUM((a.v, b.v, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29),
                   (a.v, b.v, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31));
  } else if constexpr (kParts == 2 && kCount == 16) {
    DYNGS_PAIR_SUM((a.v, b.v, 0, 2, 16, 18, 4, 6, 20, 22, 8, 10, 24, 26, 12, 14, 28, 30),
                   (a.v, b.v, 1, 3, 17, 19, 5, 7, 21, 23, 9, 11, 25, 27, 13, 15, 29, 31));
  } else if constexpr (kParts == 8) {
    DYNGS_PAIR_SUM((a.v, b.v, 0, 1, 2, 3, 8, 9, 10, 11), (a.v, b.v, 4, 5, 6, 7, 12, 13, 14, 15));
  } else if constexpr (kParts == 4 && kCount == 8) {
    DYNGS_PAIR_SUM((a.v, b.v, 0, 1, 8, 9, 4, 5, 12, 13), (a.v, b.v, 2, 3, 10, 11, 6, 7, 14, 15));
  } else if constexpr (kParts == 2 && kCount == 8) {
    DYNGS_PAIR_SUM((a.v, b.v, 0, 2, 8, 10, 4, 6, 12, 14), (a.v, b.v, 1, 3, 9, 11, 5, 7, 13, 15));
  } else if constexpr (kParts == 4) {
    DYNGS_PAIR_SUM((a.v, b.v, 0, 1, 4, 5), (a.v, b.v, 2, 3, 6, 7));
  } else {
    DYNGS_PAIR_SUM((a.v, b.v, 0, 2, 4, 6), (a.v, b.v, 1, 3, 5, 7));
  }
}
#undef DYNGS_PAIR_SUM

template <int kParts, int kCount>
DYNGS_INLINE Packet<float> tree_of_sums(const Packet<float> (&x)[kCount]) {
  if constexpr (kParts == 1) {
    return x[0];
  } else {
    Packet<float> next[(kCount + 1) / 2];
    for (int i = 0; i < kCount / 2; ++i) next[i] = halved<kParts>(x[2 * i], x[2 * i + 1]);
    if constexpr (kCount % 2 == 1) next[kCount / 2] = halved<kParts>(x[kCount - 1], Packet<float>(0.0f));
    return tree_of_sums<kParts / 2>(next);
  }
}

// sums[i] = the sum of the lanes of x[i].
template <int kCount>
DYNGS_INLINE void lane_sums(const Packet<float> (&x)[kCount], float* sums) {
  static_assert(kCount <= kLanes);
  const Packet<float> tree = tree_of_sums<kLanes>(x);
  for (int i = 0; i < kCount; ++i) sums[i] = tree[4 * (i % 4) + i / 4];
}
template <int kCount>
void lane_sums(const Packet<double> (&x)[kCount], double* sums) {
  for (int i = 0; i < kCount; ++i) sums[i] = horizontal_sum(x[i]);
}

}  // namespace dyngs

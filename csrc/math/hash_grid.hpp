// Corners and weights of a point in one level of a multiresolution hash grid (Mueller et al. 2022, "Instant Neural Graphics Primitives"):
// the rows of the eight corners of its cell, and their trilinear weights. Many points at a time, in plain loops over lanes.
#pragma once

#include "math/scalar.hpp"

namespace dyngs {

constexpr int kHashAxes = 3, kHashCorners = 1 << kHashAxes;

// A level's rows lie one after the other in the table of all levels.
struct HashLevel {
  double scale;   // cells along an axis are 1 / scale wide; sample g lies at (g - 0.5) / scale
  int64_t size;   // samples along an axis
  int64_t first;  // row
  int64_t rows;   // size^3 where `dense`, else a power of two
  bool dense;     // every sample has a row of its own; else rows are shared by a hash
};

// A function, as a GPU cannot read an array of the host.
DYNGS_INLINE constexpr uint32_t hash_prime(int axis) { return axis == 0 ? 1u : axis == 1 ? 2654435761u : 805459861u; }

// Rows within the level, and weights, of the corners of kCount points; bit a of a corner says which side along axis a.
template <int kCount, class S>
struct HashCorners {
  uint32_t rows[kHashCorners][kCount];
  S weights[kHashCorners][kCount];
};

// `coords` (kHashAxes, kCount) in [0, 1], clamped; a coordinate that is no finite number makes the weights NaN.
template <int kCount, class S>
DYNGS_INLINE void locate_hashed(const HashLevel& level, const S (*coords)[kCount], HashCorners<kCount, S>& out) {
  const S scale = static_cast<S>(level.scale);
  const uint32_t last = static_cast<uint32_t>(level.size - 1), mask = static_cast<uint32_t>(level.rows - 1);
  uint32_t low[kHashAxes][kCount], high[kHashAxes][kCount];
  S frac[kHashAxes][kCount];
  uint32_t stride = 1;
  for (int a = 0; a < kHashAxes; ++a) {
    const uint32_t factor = level.dense ? stride : hash_prime(a);
    stride *= static_cast<uint32_t>(level.size);
    for (int i = 0; i < kCount; ++i) {
      const S x = coords[a][i], inside = x > S(0) ? (x < S(1) ? x : S(1)) : S(0), at = inside * scale + S(0.5);
      const uint32_t below = static_cast<uint32_t>(static_cast<int32_t>(at));
      const uint32_t above = below + 1 < last ? below + 1 : last;
      // NOLINTNEXTLINE(misc-redundant-expression): x - x is 0, but NaN for what is no finite number
      frac[a][i] = at - static_cast<S>(static_cast<int32_t>(below)) + (x - x);
      low[a][i] = below * factor, high[a][i] = above * factor;
    }
  }
  for (int c = 0; c < kHashCorners; ++c)
    for (int i = 0; i < kCount; ++i) {
      uint32_t sum = 0, mixed = 0;
      S weight = S(1);
      for (int a = 0; a < kHashAxes; ++a) {
        const uint32_t part = c >> a & 1 ? high[a][i] : low[a][i];
        sum += part, mixed ^= part;
        weight *= c >> a & 1 ? frac[a][i] : S(1) - frac[a][i];
      }
      out.rows[c][i] = level.dense ? sum : mixed & mask;
      out.weights[c][i] = weight;
    }
}

}  // namespace dyngs

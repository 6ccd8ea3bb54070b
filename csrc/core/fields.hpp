// The native interface of radiance fields, as core/api.hpp is that of Gaussians. Shape letters: M samples, R rays, D axes,
// L levels, F features per level. Samples of a ray lie next to each other: those of ray r are [offsets[r], offsets[r + 1]).
#pragma once

#include <cstdint>
#include <span>
#include <type_traits>

#include "math/hash_grid.hpp"
#include "math/volume.hpp"

namespace dyngs {

// Hash grid -----------------------------------------------------------------------------------------------------------

template <class S>
struct HashGrid {
  std::span<const HashLevel> levels;
  int64_t dims;      // D, 3 or 4
  int64_t features;  // F, 1, 2, 4 or 8
  const S* coords;   // (M, D) in [0, 1]
  int64_t count;     // M
  int threads;

  int64_t rows() const { return levels.back().first + levels.back().rows; }
  int64_t width() const { return static_cast<int64_t>(levels.size()) * features; }
};

// f<D, F>() with the axes and features of a grid as constants.
template <class Call>
void with_grid_sizes(int64_t dims, int64_t features, const Call& f) {
  const auto of = [&]<int kDims>(std::integral_constant<int, kDims>) {
    switch (features) {
      case 1: return f.template operator()<kDims, 1>();
      case 2: return f.template operator()<kDims, 2>();
      case 4: return f.template operator()<kDims, 4>();
      default: return f.template operator()<kDims, 8>();
    }
  };
  if (dims == 3) return of(std::integral_constant<int, 3>());
  return of(std::integral_constant<int, 4>());
}

// Writes features (M, L * F): the table's rows (rows, F) between which each sample lies, interpolated, level by level.
template <class S>
void hash_grid_forward(const HashGrid<S>& grid, const S* table, S* features);

// Writes the gradient (rows, F) of sum(features * g_features) by the table.
template <class S>
void hash_grid_backward(const HashGrid<S>& grid, const S* g_features, S* g_table);

// Rays ----------------------------------------------------------------------------------------------------------------

template <class S>
struct March {
  FieldSpace<S> space;
  const bool* occupied;  // (cascades, cells, cells, cells), z the slow axis
  const S* origins;      // (R, 3) world
  const S* directions;   // (R, 3) unit
  const S* shifts;       // (R,) in [0, 1): by which fraction of a step each ray's samples are shifted
  int64_t rays;          // R
  S near;                // world units
  S step;                // length of a sample, world units
  S cone;                // it is at least so many times the distance
  int64_t most;          // samples of a ray at most
  int threads;
};

template <class S>
struct Samples {
  int32_t* rays;  // (M,)
  S* starts;      // (M,) distance along the ray
  S* ends;        // (M,)
  S* coords;      // (M, 3) of the middle in the unit cube, see unit_coords
};

// Writes the number (R,) of samples of each ray whose middle is in an occupied cell.
template <class S>
void march_count(const March<S>& march, int64_t* counts);

// Writes these samples; `offsets` (R + 1) are the sums of the counts.
template <class S>
void march_samples(const March<S>& march, const int64_t* offsets, const Samples<S>& out);

template <class S>
struct RaySamples {
  const S* densities;      // (M,) >= 0
  const S* colours;        // (M, 3)
  const S* starts;         // (M,)
  const S* ends;           // (M,)
  const int64_t* offsets;  // (R + 1)
  int64_t rays;            // R
  S transmittance_min;     // a ray ends when it is below this
  int threads;
};

template <class S>
struct Composited {
  S* colour;         // (R, 3) sum of weight times colour
  S* transmittance;  // (R,) that is left
  S* depth;          // (R,) sum of weight times the distance of the middle
  S* weights;        // (M,)
};

// alpha = 1 - exp(-density * length), weight = transmittance before it * alpha.
template <class S>
void composite_forward(const RaySamples<S>& in, const Composited<S>& out);

// Gradients by densities (M,) and colours (M, 3) from those by the first three of the outputs.
template <class S>
void composite_backward(const RaySamples<S>& in, const Composited<const S>& grads, S* g_densities, S* g_colours);

// Writes whether each sample (M,) is reached: the transmittance before it is at least transmittance_min; and how many of each ray
// (R,) are. `colours` is not read.
template <class S>
void reached_samples(const RaySamples<S>& in, bool* reached, int64_t* counts);

}  // namespace dyngs

// Python bindings of radiance fields: hash grids, marching and compositing. Argument unpacking only.
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <vector>

#include "bind/arrays.hpp"
#include "core/fields.hpp"

namespace dyngs {
namespace {

// Scale, samples along an axis, and rows of each level.
using LevelSizes = std::vector<std::tuple<double, int64_t, int64_t>>;

std::vector<HashLevel> hash_levels(const LevelSizes& sizes) {
  std::vector<HashLevel> levels;
  int64_t first = 0;
  for (const auto& [scale, size, rows] : sizes) {
    if (size < 1 || size > 1 << 20 || !(scale >= 0 && scale <= size)) throw nb::value_error("hash grid: no such level");
    int64_t samples = 1;
    for (int64_t a = 0; a < kHashAxes; ++a) samples = std::min(samples * size, int64_t{1} << 40);
    const bool dense = samples == rows;
    if (rows < 1 || rows >= int64_t{1} << 31 || (!dense && (rows & (rows - 1)) != 0))
      throw nb::value_error("hash grid: the rows of a level are neither all samples nor a power of two");
    levels.push_back({scale, size, first, rows, dense});
    first += rows;
  }
  if (levels.empty()) throw nb::value_error("hash grid: no levels");
  return levels;
}

template <class S>
HashGrid<S> hash_grid(const Rows<const S>& coords, const std::vector<HashLevel>& levels, int64_t features,
                      int threads) {
  if (coords.shape(1) != kHashAxes) throw nb::value_error("hash grid: coordinates of 3 axes");
  if (features != 1 && features != 2 && features != 4 && features != 8)
    throw nb::value_error("hash grid: 1, 2, 4 or 8 features per level");
  return {levels, features, coords.data(), static_cast<int64_t>(coords.shape(0)), threads};
}

template <class S>
void hash_forward(Rows<const S> coords, Rows<const S> table, const LevelSizes& sizes, Rows<S> features, int threads) {
  const auto levels = hash_levels(sizes);
  const HashGrid<S> grid = hash_grid(coords, levels, table.shape(1), threads);
  const S* from = checked(table, grid.rows(), grid.features, "hash grid: table");
  S* to = checked(features, grid.count, grid.width(), "hash grid: features");
  nb::gil_scoped_release release;
  hash_grid_forward(grid, from, to);
}

template <class S>
void hash_backward(Rows<const S> coords, const LevelSizes& sizes, Rows<const S> g_features, Rows<S> g_table,
                   int threads) {
  const auto levels = hash_levels(sizes);
  const HashGrid<S> grid = hash_grid(coords, levels, g_table.shape(1), threads);
  const S* from = checked(g_features, grid.count, grid.width(), "hash grid: gradient");
  S* to = checked(g_table, grid.rows(), grid.features, "hash grid: gradient of the table");
  nb::gil_scoped_release release;
  hash_grid_backward(grid, from, to);
}

// True if the samples of each ray lie within `count`. Offsets on a GPU are not read, see bind/arrays.hpp.
bool offsets_fit(const int64_t* offsets, int64_t rays, int64_t count) {
  return kOnGpu || (offsets[0] == 0 && offsets[rays] == count && std::is_sorted(offsets, offsets + rays + 1));
}

// Arrays of S come first: a capsule is good for one look, and their type decides which overload is meant.

// Centre, half side, cascades, cells.
using SpaceSizes = std::tuple<std::tuple<double, double, double>, double, int64_t, int64_t>;
// Near, step, cone, most.
using MarchOptions = std::tuple<double, double, double, int64_t>;

template <class S>
March<S> march_of(const SpaceSizes& sizes, const Array<const bool>& occupied, const Rows<const S>& origins,
                  const Rows<const S>& directions, const Array<const S>& shifts, const MarchOptions& options,
                  int threads) {
  const auto& [centre, half, cascades, cells] = sizes;
  const auto& [near, step, cone, most] = options;
  if (!(half > 0) || !(step > 0) || !(cone >= 0) || cascades < 1 || cascades > 16 || cells < 1 || cells > 1024)
    throw nb::value_error("march: no such space");
  const int64_t rays = origins.shape(0);
  March<S> march{};
  march.space = {
      {static_cast<S>(std::get<0>(centre)), static_cast<S>(std::get<1>(centre)), static_cast<S>(std::get<2>(centre))},
      static_cast<S>(half),
      cascades,
      cells};
  march.occupied = checked(occupied, cascades * cells * cells * cells, "march: cells");
  march.origins = checked(origins, rays, 3, "march");
  march.directions = checked(directions, rays, 3, "march");
  march.shifts = checked(shifts, rays, "march: shifts");
  march.rays = rays, march.near = static_cast<S>(near), march.step = static_cast<S>(step);
  march.cone = static_cast<S>(cone), march.most = most, march.threads = threads;
  return march;
}

template <class S>
void count_samples(Rows<const S> origins, Rows<const S> directions, Array<const S> shifts, const SpaceSizes& sizes,
                   Array<const bool> occupied, const MarchOptions& options, Array<int64_t> counts, int threads) {
  const March<S> march = march_of<S>(sizes, occupied, origins, directions, shifts, options, threads);
  int64_t* to = checked(counts, march.rays, "march: counts");
  nb::gil_scoped_release release;
  march_count(march, to);
}

template <class S>
void write_samples(Rows<const S> origins, Rows<const S> directions, Array<const S> shifts, const SpaceSizes& sizes,
                   Array<const bool> occupied, const MarchOptions& options, Array<const int64_t> offsets,
                   const std::tuple<Array<int32_t>, Array<S>, Array<S>, Rows<S>>& samples, int threads) {
  const March<S> march = march_of<S>(sizes, occupied, origins, directions, shifts, options, threads);
  const auto& [rays, starts, ends, coords] = samples;
  const int64_t count = rays.size(), *from = checked(offsets, march.rays + 1, "march: offsets");
  if (!offsets_fit(from, march.rays, count)) throw nb::value_error("march: offsets that do not fit the samples");
  const Samples<S> to{checked(rays, count, "march"), checked(starts, count, "march"), checked(ends, count, "march"),
                      checked(coords, count, 3, "march")};
  nb::gil_scoped_release release;
  march_samples(march, from, to);
}

template <class S>
RaySamples<S> ray_samples(const Array<const S>& densities, const MaybeArray<const S>& colours,
                          const Array<const S>& starts, const Array<const S>& ends, const Array<const int64_t>& offsets,
                          double transmittance_min, int threads) {
  const int64_t count = densities.size(), rays = static_cast<int64_t>(offsets.size()) - 1;
  const int64_t* from = offsets.data();
  if (rays < 0 || !offsets_fit(from, rays, count))
    throw nb::value_error("composite: offsets that do not fit the samples");
  return {densities.data(),
          checked(colours, 3 * count, "composite: colours"),
          checked(starts, count, "composite: starts"),
          checked(ends, count, "composite: ends"),
          from,
          rays,
          static_cast<S>(transmittance_min),
          threads};
}

template <class S>
void composite_samples(Array<const S> densities, Array<const S> colours, Array<const S> starts, Array<const S> ends,
                       Array<const int64_t> offsets, double transmittance_min,
                       const std::tuple<Array<S>, Array<S>, Array<S>, Array<S>>& out, int threads) {
  const RaySamples<S> in = ray_samples<S>(densities, colours, starts, ends, offsets, transmittance_min, threads);
  const auto& [colour, transmittance, depth, weights] = out;
  const Composited<S> to{checked(colour, 3 * in.rays, "composite"), checked(transmittance, in.rays, "composite"),
                         checked(depth, in.rays, "composite"),
                         checked(weights, static_cast<int64_t>(densities.size()), "composite")};
  nb::gil_scoped_release release;
  composite_forward(in, to);
}

template <class S>
void composite_samples_backward(Array<const S> densities, Array<const S> colours, Array<const S> starts,
                                Array<const S> ends, Array<const int64_t> offsets, double transmittance_min,
                                const std::tuple<Array<const S>, Array<const S>, Array<const S>>& grads,
                                Array<S> g_densities, Array<S> g_colours, int threads) {
  const RaySamples<S> in = ray_samples<S>(densities, colours, starts, ends, offsets, transmittance_min, threads);
  const auto& [colour, transmittance, depth] = grads;
  const Composited<const S> from{checked(colour, 3 * in.rays, "composite"),
                                 checked(transmittance, in.rays, "composite"), checked(depth, in.rays, "composite"),
                                 nullptr};
  const int64_t count = densities.size();
  S* by_densities = checked(g_densities, count, "composite");
  S* by_colours = checked(g_colours, 3 * count, "composite");
  nb::gil_scoped_release release;
  composite_backward(in, from, by_densities, by_colours);
}

template <class S>
void reached(Array<const S> densities, Array<const S> starts, Array<const S> ends, Array<const int64_t> offsets,
             double transmittance_min, Array<bool> which, Array<int64_t> counts, int threads) {
  const RaySamples<S> in = ray_samples<S>(densities, std::nullopt, starts, ends, offsets, transmittance_min, threads);
  bool* to = checked(which, static_cast<int64_t>(densities.size()), "reached");
  int64_t* numbers = checked(counts, in.rays, "reached");
  nb::gil_scoped_release release;
  reached_samples(in, to, numbers);
}

}  // namespace

void bind_fields(nb::module_& module) {
  for_each_scalar([&]<class S>() {
    module.def("hash_grid_forward", hash_forward<S>);
    module.def("hash_grid_backward", hash_backward<S>);
    module.def("march_count", count_samples<S>);
    module.def("march_samples", write_samples<S>);
    module.def("composite_forward", composite_samples<S>);
    module.def("composite_backward", composite_samples_backward<S>);
    module.def("reached_samples", reached<S>);
  });
}

}  // namespace dyngs

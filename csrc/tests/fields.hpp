// Inputs of the tests of radiance fields, in float64, and the CPU kernels' results in either precision.
#pragma once

#include <cmath>
#include <cstdint>
#include <memory>
#include <vector>

#include "core/fields.hpp"
#include "tests/check.hpp"

namespace check {

using namespace dyngs;

// Hash grids ----------------------------------------------------------------------------------------------------------

// Levels with `most_rows` at most; what is larger is hashed.
inline std::vector<HashLevel> levels_of(const std::vector<int64_t>& sizes, int64_t most_rows) {
  std::vector<HashLevel> levels;
  int64_t first = 0;
  for (const int64_t size : sizes) {
    int64_t samples = 1;
    for (int64_t a = 0; a < kHashAxes; ++a) samples *= size;
    const int64_t rows = std::min(samples, most_rows);
    levels.push_back({static_cast<double>(size) - 1, size, first, rows, rows == samples});
    first += rows;
  }
  return levels;
}

struct GridCase {
  std::vector<HashLevel> levels;
  int64_t features;
  Values coords, table, weights;  // (M, 3), (rows, F), (M, L * F) of the features in a sum

  int64_t count() const { return static_cast<int64_t>(coords.size()) / kHashAxes; }
};

// `count` points in and around the unit cube, or around its middle alone.
inline GridCase grid_case(const std::vector<HashLevel>& levels, int64_t features, int64_t count, double around = 0.6) {
  const int64_t rows = levels.back().first + levels.back().rows;
  return {levels, features, uniforms(count * kHashAxes, 0.5 - around, 0.5 + around), uniforms(rows * features, -1, 1),
          uniforms(count * static_cast<int64_t>(levels.size()) * features, -1, 1)};
}

template <class S>
struct GridResults {
  std::vector<S> features, by_table;
};

template <class S>
GridResults<S> grid_on_cpu(const GridCase& c, int threads = 1) {
  const auto coords = as<S>(c.coords), table = as<S>(c.table), weights = as<S>(c.weights);
  GridResults<S> r{std::vector<S>(weights.size(), S(7)), std::vector<S>(table.size(), S(7))};
  const HashGrid<S> grid{c.levels, c.features, coords.data(), c.count(), threads};
  hash_grid_forward(grid, table.data(), r.features.data());
  hash_grid_backward(grid, weights.data(), r.by_table.data());
  return r;
}

// Rays ----------------------------------------------------------------------------------------------------------------

struct MarchCase {
  FieldSpace<double> space;
  std::vector<bool> occupied;
  Values origins, directions, shifts;  // (R, 3), (R, 3), (R,)
  double near, step, cone;
  int64_t most;

  int64_t rays() const { return static_cast<int64_t>(shifts.size()); }
};

inline Values unit_vectors(Values v) {
  for (size_t i = 0; i < v.size(); i += 3) {
    const double norm = std::sqrt(v[i] * v[i] + v[i + 1] * v[i + 1] + v[i + 2] * v[i + 2]);
    for (size_t a = i; a < i + 3; ++a) v[a] = static_cast<float>(v[a] / norm);
  }
  return v;
}

// Rays from a distance of 3 to near the middle, of which some miss; a third of the cells is occupied.
inline MarchCase march_case(int64_t rays, int64_t cascades, double cone) {
  MarchCase c{{{0.125, 0.25, -0.125}, 1, cascades, 8}, {}, {}, {}, uniforms(rays, 0, 0.99), 0.0625, 0.03125, cone, 500};
  c.origins = unit_vectors(uniforms(3 * rays, -1, 1));
  Values aims = uniforms(3 * rays, -2, 2);
  for (size_t i = 0; i < aims.size(); ++i) c.origins[i] *= 3, aims[i] -= c.origins[i];
  c.directions = unit_vectors(aims);
  for (int64_t i = 0; i < cascades * 512; ++i) c.occupied.push_back(uniform(0, 1) < 1.0 / 3);
  return c;
}

// Cells as the kernels want them: a vector of bool has no array.
inline std::unique_ptr<bool[]> cells_of(const MarchCase& c) {
  auto cells = std::make_unique<bool[]>(c.occupied.size());
  std::copy(c.occupied.begin(), c.occupied.end(), cells.get());
  return cells;
}

inline FieldSpace<float> single(const FieldSpace<double>& s) {
  const auto x = as<float>(Values(s.centre, s.centre + 3));
  return {{x[0], x[1], x[2]}, static_cast<float>(s.half), s.cascades, s.cells};
}
inline FieldSpace<double> as_space(const FieldSpace<double>& s, double) { return s; }
inline FieldSpace<float> as_space(const FieldSpace<double>& s, float) { return single(s); }

template <class S>
struct Marched {
  std::vector<int64_t> offsets;
  std::vector<int32_t> rays;
  std::vector<S> starts, ends, coords;
};

inline std::vector<int64_t> sums_of(const std::vector<int64_t>& counts) {
  std::vector<int64_t> offsets{0};
  for (const int64_t count : counts) offsets.push_back(offsets.back() + count);
  return offsets;
}

template <class S>
Marched<S> march_on_cpu(const MarchCase& c, int threads = 1) {
  const auto origins = as<S>(c.origins), directions = as<S>(c.directions), shifts = as<S>(c.shifts);
  const auto cells = cells_of(c);
  const March<S> march{as_space(c.space, S()),
                       cells.get(),
                       origins.data(),
                       directions.data(),
                       shifts.data(),
                       c.rays(),
                       static_cast<S>(c.near),
                       static_cast<S>(c.step),
                       static_cast<S>(c.cone),
                       c.most,
                       threads};
  std::vector<int64_t> counts(c.rays());
  march_count(march, counts.data());
  Marched<S> m{sums_of(counts), {}, {}, {}, {}};
  const int64_t count = m.offsets.back();
  m.rays.assign(count, -1), m.starts.assign(count, S(NAN)), m.ends = m.starts, m.coords.assign(3 * count, S(NAN));
  march_samples(march, m.offsets.data(), {m.rays.data(), m.starts.data(), m.ends.data(), m.coords.data()});
  return m;
}

// Compositing ---------------------------------------------------------------------------------------------------------

struct SampleCase {
  std::vector<int64_t> offsets;
  Values densities, colours, starts, ends;
  Values g_colour, g_transmittance, g_depth;  // (R, 3), (R,), (R,)
  double transmittance_min;

  int64_t rays() const { return static_cast<int64_t>(offsets.size()) - 1; }
};

// Numbers of samples of so many rays, from none to 39.
inline std::vector<int64_t> varied_counts(int64_t rays) {
  std::vector<int64_t> counts(rays);
  for (int64_t ray = 0; ray < rays; ++ray) counts[ray] = ray * 7 % 40;
  return counts;
}

// Rays with so many samples each.
inline SampleCase sample_case(const std::vector<int64_t>& counts, double density, double transmittance_min) {
  const std::vector<int64_t> offsets = sums_of(counts);
  const int64_t count = offsets.back(), rays = static_cast<int64_t>(counts.size());
  SampleCase c{offsets,
               uniforms(count, 0, density),
               uniforms(3 * count, 0, 1),
               uniforms(count, 0, 1),
               uniforms(count, 0.125, 1),
               uniforms(3 * rays, -1, 1),
               uniforms(rays, -1, 1),
               uniforms(rays, -1, 1),
               transmittance_min};
  for (int64_t i = 0; i < count; ++i) c.starts[i] += 0.25 * static_cast<double>(i % 16), c.ends[i] += c.starts[i];
  c.starts = as<double>(as<float>(c.starts)), c.ends = as<double>(as<float>(c.ends));
  return c;
}

template <class S>
struct Composition {
  std::vector<S> colour, transmittance, depth, weights, by_densities, by_colours;
  std::vector<char> reached;
  std::vector<int64_t> counts;
};

template <class S>
Composition<S> empty_composition(const SampleCase& c) {
  const size_t count = c.densities.size(), rays = c.g_depth.size();
  const auto fill = [](size_t n) { return std::vector<S>(n, S(7)); };
  return {fill(3 * rays),
          fill(rays),
          fill(rays),
          fill(count),
          fill(count),
          fill(3 * count),
          std::vector<char>(count, 7),
          std::vector<int64_t>(rays, -7)};
}

template <class S>
Composition<S> composite_on_cpu(const SampleCase& c, int threads = 1) {
  const auto densities = as<S>(c.densities), colours = as<S>(c.colours), starts = as<S>(c.starts), ends = as<S>(c.ends);
  const auto g_colour = as<S>(c.g_colour), g_transmittance = as<S>(c.g_transmittance), g_depth = as<S>(c.g_depth);
  Composition<S> r = empty_composition<S>(c);
  const RaySamples<S> in{densities.data(),
                         colours.data(),
                         starts.data(),
                         ends.data(),
                         c.offsets.data(),
                         c.rays(),
                         static_cast<S>(c.transmittance_min),
                         threads};
  composite_forward<S>(in, {r.colour.data(), r.transmittance.data(), r.depth.data(), r.weights.data()});
  composite_backward<S>(in, {g_colour.data(), g_transmittance.data(), g_depth.data(), nullptr}, r.by_densities.data(),
                        r.by_colours.data());
  const auto reached = std::make_unique<bool[]>(densities.size());
  reached_samples(in, reached.get(), r.counts.data());
  std::copy_n(reached.get(), densities.size(), r.reached.begin());
  return r;
}

}  // namespace check

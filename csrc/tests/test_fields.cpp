// The kernels of radiance fields, as a program without Python: against plain formulas in double, their gradients against central
// differences of these, float against double, several threads against one; points outside, NaN, and rays that miss all samples.
#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "tests/check.hpp"
#include "tests/fields.hpp"

namespace {

using namespace dyngs;
using namespace check;

constexpr double kNone = std::numeric_limits<double>::quiet_NaN(), kFar = std::numeric_limits<double>::infinity();

// Hash grids ----------------------------------------------------------------------------------------------------------

// The row of a level's sample, and the formula of the hash (Mueller et al. 2022, equation 4).
int64_t plain_row(const HashLevel& level, const std::vector<int64_t>& index) {
  const uint64_t primes[] = {1, 2654435761, 805459861};
  int64_t dense = 0, stride = 1;
  uint64_t hash = 0;
  for (size_t a = 0; a < index.size(); ++a) {
    dense += index[a] * stride, stride *= level.size;
    hash ^= static_cast<uint64_t>(index[a]) * primes[a] % (uint64_t{1} << 32);
  }
  return level.dense ? dense : static_cast<int64_t>(hash % static_cast<uint64_t>(level.rows));
}

// Calls f(feature (M, L * F), entry of the table, weight) for all that a feature is a sum of.
template <class F>
void for_each_term(const GridCase& c, const F& f) {
  const int64_t width = static_cast<int64_t>(c.levels.size()) * c.features;
  for (int64_t m = 0; m < c.count(); ++m)
    for (size_t l = 0; l < c.levels.size(); ++l)
      for (int corner = 0; corner < kHashCorners; ++corner) {
        const HashLevel& level = c.levels[l];
        std::vector<int64_t> index;
        double weight = 1;
        for (int64_t a = 0; a < kHashAxes; ++a) {
          const double at = std::clamp(c.coords[m * kHashAxes + a], 0.0, 1.0) * level.scale + 0.5,
                       below = std::floor(at);
          const bool high = (corner >> a & 1) != 0;
          weight *= high ? at - below : 1 - (at - below);
          index.push_back(std::min(static_cast<int64_t>(below) + (high ? 1 : 0), level.size - 1));
        }
        const int64_t row = level.first + plain_row(level, index);
        for (int64_t k = 0; k < c.features; ++k)
          f(m * width + static_cast<int64_t>(l) * c.features + k, row * c.features + k, weight);
      }
}

Values plain_features(const GridCase& c, const Values& table) {
  Values features(c.weights.size());
  for_each_term(c, [&](int64_t feature, int64_t entry, double weight) { features[feature] += weight * table[entry]; });
  return features;
}

void test_hash_grid(int64_t features) {
  const auto levels = levels_of({3, 6, 17, 24}, 512);
  const GridCase c = grid_case(levels, features, 61);
  const std::string what = std::to_string(features) + " features";
  const auto d = grid_on_cpu<double>(c);
  Values by_table(c.table.size());
  for_each_term(c, [&](int64_t k, int64_t entry, double weight) { by_table[entry] += weight * c.weights[k]; });
  expect_close("features, " + what, d.features, plain_features(c, c.table), 1e-12);
  expect_close("gradient, " + what, d.by_table, by_table, 1e-12);
  const auto total = [&](const Values& table) { return dot(c.weights, plain_features(c, table)); };
  expect_gradient("slopes, " + what, total, c.table, d.by_table, 1e-2, 1e-8);
  const auto f = grid_on_cpu<float>(c);
  expect_close("float features, " + what, f.features, d.features, 2e-5);
  expect_close("float gradient, " + what, f.by_table, d.by_table, 2e-5);
}

// Enough points for several tasks; 7 threads: several for one level.
void test_hash_grid_threads() {
  const GridCase c = grid_case(levels_of({3, 6, 17, 24}, 512), 4, 5000);
  const auto one = grid_on_cpu<float>(c);
  for (const int threads : {2, 4, 7}) {
    const auto other = grid_on_cpu<float>(c, threads);
    expect_same_bits("features on threads", other.features, one.features);
    expect_same_bits("gradient on threads", other.by_table, one.by_table);
  }
}

// At its samples a dense level has the values of their rows.
void test_samples_of_a_level() {
  const auto levels = levels_of({5}, 125);
  GridCase c = grid_case(levels, 2, 0);
  for (int64_t i = 1; i < 4; ++i)
    for (const int64_t at : {i, (i + 1) % 4 == 0 ? 1 : (i + 1) % 4, int64_t{2}})
      c.coords.push_back((static_cast<double>(at) - 0.5) / levels[0].scale);
  c.weights.resize(static_cast<size_t>(2 * c.count()));
  const auto found = grid_on_cpu<double>(c).features;
  for (int64_t m = 0; m < c.count(); ++m) {
    int64_t row = 0;
    for (int a = 2; a >= 0; --a) row = 5 * row + std::lround(c.coords[3 * m + a] * 4 + 0.5);
    for (int f = 0; f < 2; ++f) expect_near("at a sample", found[2 * m + f], c.table[2 * row + f], 1e-14);
  }
}

void test_points_outside() {
  const auto levels = levels_of({4, 40}, 256);
  GridCase c = grid_case(levels, 4, 300, 3.0), inside = c;
  for (double& x : inside.coords) x = std::clamp(x, 0.0, 1.0);
  c.coords[0] = 1e30, inside.coords[0] = 1, c.coords[1] = -1e30, inside.coords[1] = 0;
  const auto one = grid_on_cpu<float>(c), other = grid_on_cpu<float>(inside);
  expect_same_bits("features outside", one.features, other.features);
  expect_same_bits("gradient outside", one.by_table, other.by_table);
}

void test_nan_points_and_rows() {
  const auto levels = levels_of({4, 30}, 256);
  const GridCase good = grid_case(levels, 2, 50, 0.45);
  const auto clean = grid_on_cpu<float>(good);
  for (const double bad : {kNone, kFar, -kFar}) {
    GridCase c = good;
    c.coords[3 * 7 + 1] = bad;
    const auto found = grid_on_cpu<float>(c);
    for (size_t i = 0; i < found.features.size(); ++i)
      expect(i / 4 == 7 ? std::isnan(found.features[i]) : found.features[i] == clean.features[i],
             "a point that is no number has no features, the others have theirs");
    const auto spoilt = std::count_if(found.by_table.begin(), found.by_table.end(), [](float x) { return x != x; });
    expect(spoilt > 0 && spoilt <= 2 * 2 * 8, "it spoils the gradient by the rows around it alone");
  }
  GridCase c = good;
  c.table[2 * 21] = kNone;  // sample (1, 1, 1) of the coarser level
  const auto found = grid_on_cpu<float>(c);
  int64_t spoilt = 0;
  for (int64_t m = 0; m < c.count(); ++m) {
    bool is_near = true;
    for (int a = 0; a < 3; ++a) is_near &= std::abs(c.coords[3 * m + a] * 3 + 0.5 - 1) < 1;
    const bool is_spoilt = std::isnan(found.features[4 * m]);
    spoilt += is_spoilt ? 1 : 0;
    expect(is_spoilt || !is_near, "NaN of a row reaches the points around it");
    for (int k = 1; k < 4; ++k) expect(std::isfinite(found.features[4 * m + k]), "and no other feature");
  }
  expect(spoilt > 0 && spoilt < c.count(), "NaN of a row reaches some points");
  expect_same_bits("the gradient does not see the table", found.by_table, clean.by_table);
}

void test_no_points() {
  const auto levels = levels_of({4, 30}, 256);
  const auto found = grid_on_cpu<float>(grid_case(levels, 1, 0), 4);
  expect(std::all_of(found.by_table.begin(), found.by_table.end(), [](float x) { return x == 0; }), "no points");
}

// Marching ------------------------------------------------------------------------------------------------------------

// The cell of a point, -1 outside of all cubes.
int64_t plain_cell(const FieldSpace<double>& s, const double* x) {
  double norm = 0;
  for (int a = 0; a < 3; ++a) norm = std::max(norm, std::abs(x[a] - s.centre[a]) / s.half);
  for (int64_t k = 0; k < s.cascades; ++k) {
    const double half = s.half * std::pow(2, k);
    if (norm * s.half > half) continue;
    int64_t index = k;
    for (int a = 2; a >= 0; --a) {
      const double place = (x[a] - s.centre[a] + half) / (2 * half) * static_cast<double>(s.cells);
      index = index * s.cells + std::clamp<int64_t>(static_cast<int64_t>(place), 0, s.cells - 1);
    }
    return index;
  }
  return -1;
}

// Distances at which a ray is in the outermost cube; a direction has no zeros here.
std::pair<double, double> plain_crossing(const MarchCase& c, int64_t ray) {
  const double half = c.space.half * std::pow(2, c.space.cascades - 1);
  double from = c.near, to = kFar;
  for (int64_t i = 3 * ray; i < 3 * ray + 3; ++i) {
    const double offset = c.origins[i] - c.space.centre[i % 3], d = c.directions[i];
    const double one = (-half - offset) / d, two = (half - offset) / d;
    from = std::max(from, std::min(one, two)), to = std::min(to, std::max(one, two));
  }
  return {from, to};
}

void middle_of(const MarchCase& c, int64_t ray, double start, double end, double* x) {
  for (int a = 0; a < 3; ++a) x[a] = c.origins[3 * ray + a] + (start + end) / 2 * c.directions[3 * ray + a];
}

// Samples of one length, where every step is tried.
void test_march(int64_t cascades) {
  const MarchCase c = march_case(700, cascades, 0);
  const auto d = march_on_cpu<double>(c);
  const std::string what = ", " + std::to_string(cascades) + " cubes";
  std::vector<int64_t> counts;
  Values starts;
  for (int64_t ray = 0; ray < c.rays(); ++ray) {
    const auto [from, to] = plain_crossing(c, ray);
    const size_t before = starts.size();
    for (int64_t k = 0;; ++k) {
      const double at = from + (static_cast<double>(k) + c.shifts[ray]) * c.step;
      if (!(at < to)) break;
      double x[3];
      middle_of(c, ray, at, at + c.step, x);
      const int64_t cell = plain_cell(c.space, x);
      if (cell >= 0 && c.occupied[cell]) starts.push_back(at);
    }
    counts.push_back(static_cast<int64_t>(starts.size() - before));
  }
  expect(d.offsets == sums_of(counts), "how many samples rays have" + what);
  expect_close("where they start" + what, d.starts, starts, 1e-12);
  const auto missed = std::count(counts.begin(), counts.end(), 0);
  expect(starts.size() > 4000 && (missed > 10) == (cascades == 1), "rays, of which some miss a single cube" + what);
}

// Properties of samples that grow with the distance; `exact`: how far the type rounds.
template <class S>
void test_growing_samples(double exact) {
  const MarchCase c = march_case(300, 3, 0.0625);
  const auto found = march_on_cpu<S>(c);
  expect(found.offsets.back() > 3000, "samples enough");
  for (int64_t ray = 0; ray < c.rays(); ++ray)
    for (int64_t i = found.offsets[ray]; i < found.offsets[ray + 1]; ++i) {
      const double start = found.starts[i], end = found.ends[i];
      expect(found.rays[i] == ray, "samples of a ray lie together");
      expect_near("their length", end - start, std::max(c.step, c.cone * start), exact);
      expect(i == found.offsets[ray] || start >= static_cast<double>(found.ends[i - 1]) - exact, "they are in order");
      double x[3], norm = 0;
      middle_of(c, ray, start, end, x);
      for (int a = 0; a < 3; ++a) norm = std::max(norm, std::abs(x[a] - c.space.centre[a]));
      for (int a = 0; a < 3; ++a) {
        const double y = x[a] - c.space.centre[a];
        const double unit = 0.5 + (norm <= 1 ? y : (2 - 1 / norm) * y / norm) / 4;
        expect_near("where they are in the unit cube", found.coords[3 * i + a], unit, exact);
      }
      const int64_t cell = plain_cell(c.space, x);  // unless the middle is on a wall, up to rounding
      expect(exact > 1e-9 || (cell >= 0 && c.occupied[cell]), "their cells are occupied");
    }
}

template <class S>
void test_march_threads() {
  const MarchCase c = march_case(900, 2, 0.01);
  const auto one = march_on_cpu<S>(c);
  expect(std::all_of(one.starts.begin(), one.starts.end(), [](S x) { return std::isfinite(x); }), "all were written");
  for (const int threads : {2, 4}) {
    const auto other = march_on_cpu<S>(c, threads);
    expect(other.offsets == one.offsets && other.rays == one.rays, "samples on threads");
    expect_same_bits("starts on threads", other.starts, one.starts);
    expect_same_bits("ends on threads", other.ends, one.ends);
    expect_same_bits("coordinates on threads", other.coords, one.coords);
  }
}

// One cube of half side 1 around 0, with 4 cells along an axis, and one ray of (origin, direction).
MarchCase one_ray(const Values& ray, bool occupied = true) {
  return {{{0, 0, 0}, 1, 1, 4},
          std::vector<bool>(64, occupied),
          {ray.begin(), ray.begin() + 3},
          {ray.begin() + 3, ray.end()},
          {0.25},
          0,
          0.125,
          0,
          100};
}

template <class S>
void test_degenerate_rays() {
  const auto count = [](const MarchCase& c) {
    const auto found = march_on_cpu<S>(c);
    for (const S x : found.starts) expect(std::isfinite(x), "samples of a hard ray are written");
    return found.offsets.back();
  };
  expect(count(one_ray({-5, 0.125, 0.25, 1, 0, 0})) == 16, "a ray through all of a full cube");
  expect(count(one_ray({-5, 0.125, 0.25, 1, 0, 0}, false)) == 0, "a ray through an empty cube");
  expect(count(one_ray({-5, 0.125, 0.25, -1, 0, 0})) == 0, "a ray that goes away");
  expect(count(one_ray({-5, 0.125, 2, 1, 0, 0})) == 0, "a ray that misses");
  expect(count(one_ray({0, 0, 0, 0, 0, 1})) == 8, "a ray that begins in the middle");
  expect(count(one_ray({kNone, 0, 0, 1, 0, 0})) == 0, "a ray from nowhere");
  expect(count(one_ray({-5, 1, 1, 1, 0, 0})) <= 17, "a ray along an edge ends");
  expect(count(one_ray({0, 0, 0, 0, 0, 0})) <= 100, "a ray of no direction ends");
  expect(count(one_ray({-1e9, 0, 0, 1, 0, 0})) <= 100, "a ray from so far that a step is lost ends");
  MarchCase c = one_ray({-5, 0.125, 0.25, 1, 0, 0});
  c.most = 5;
  expect(count(c) == 5, "no more samples than allowed");
  c.origins = c.directions = c.shifts = {};
  expect(count(c) == 0, "no rays");
}

// Compositing ---------------------------------------------------------------------------------------------------------

struct Plain {
  Values colour, transmittance, depth, weights;
  std::vector<char> reached;
};

Plain plain_composition(const SampleCase& c, const Values& densities, const Values& colours) {
  Plain p{Values(3 * c.rays()), Values(c.rays(), 1), Values(c.rays()), Values(densities.size()), {}};
  p.reached.resize(densities.size());
  for (int64_t ray = 0; ray < c.rays(); ++ray)
    for (int64_t i = c.offsets[ray]; i < c.offsets[ray + 1]; ++i) {
      double& through = p.transmittance[ray];
      if (through < c.transmittance_min) break;
      const double left = std::exp(-densities[i] * (c.ends[i] - c.starts[i]));
      p.reached[i] = 1, p.weights[i] = through * (1 - left), through *= left;
      for (int k = 0; k < 3; ++k) p.colour[3 * ray + k] += p.weights[i] * colours[3 * i + k];
      p.depth[ray] += p.weights[i] * (c.starts[i] + c.ends[i]) / 2;
    }
  return p;
}

void test_composition(double density, double transmittance_min) {
  const SampleCase c = sample_case({5, 0, 1, 30, 0, 64, 9}, density, transmittance_min);
  const std::string what = ", density " + std::to_string(density);
  const auto d = composite_on_cpu<double>(c);
  const Plain p = plain_composition(c, c.densities, c.colours);
  expect_close("colour" + what, d.colour, p.colour, 1e-12);
  expect_close("transmittance" + what, d.transmittance, p.transmittance, 1e-12);
  expect_close("depth" + what, d.depth, p.depth, 1e-12);
  expect_close("weights" + what, d.weights, p.weights, 1e-12);
  expect(d.reached == p.reached, "which are reached" + what);
  for (int64_t ray = 0; ray < c.rays(); ++ray)
    expect(d.counts[ray] == std::count(p.reached.begin() + c.offsets[ray], p.reached.begin() + c.offsets[ray + 1], 1),
           "how many are reached" + what);
  const auto total = [&](const Values& densities, const Values& colours) {
    const Plain q = plain_composition(c, densities, colours);
    return dot(c.g_colour, q.colour) + dot(c.g_transmittance, q.transmittance) + dot(c.g_depth, q.depth);
  };
  expect_gradient(
      "slopes by densities" + what, [&](const Values& x) { return total(x, c.colours); }, c.densities, d.by_densities,
      1e-5, 1e-7, 109);
  expect_gradient(
      "slopes by colours" + what, [&](const Values& x) { return total(c.densities, x); }, c.colours, d.by_colours, 1e-3,
      1e-8, 40);
  const auto f = composite_on_cpu<float>(c);
  expect_close("float colour" + what, f.colour, d.colour, 1e-5);
  expect_close("float gradient by densities" + what, f.by_densities, d.by_densities, 1e-5);
  expect_close("float gradient by colours" + what, f.by_colours, d.by_colours, 1e-5);
}

void test_composition_threads() {
  const SampleCase c = sample_case(varied_counts(500), 3, 1e-4);
  const auto one = composite_on_cpu<float>(c);
  for (const int threads : {2, 4}) {
    const auto other = composite_on_cpu<float>(c, threads);
    expect_same_bits("colour on threads", other.colour, one.colour);
    expect_same_bits("depth on threads", other.depth, one.depth);
    expect_same_bits("weights on threads", other.weights, one.weights);
    expect_same_bits("gradient by densities on threads", other.by_densities, one.by_densities);
    expect_same_bits("gradient by colours on threads", other.by_colours, one.by_colours);
    expect(other.reached == one.reached && other.counts == one.counts, "reached on threads");
  }
}

// Samples that are not reached have no effect.
void test_reached_samples_only() {
  const SampleCase c = sample_case({64, 64, 20}, 3, 0.01);
  const auto all = composite_on_cpu<float>(c);
  SampleCase rest = c;
  rest.offsets = sums_of(all.counts);
  rest.densities = rest.colours = rest.starts = rest.ends = {};
  for (size_t i = 0; i < c.densities.size(); ++i) {
    if (all.reached[i] == 0) continue;
    rest.densities.push_back(c.densities[i]), rest.starts.push_back(c.starts[i]), rest.ends.push_back(c.ends[i]);
    rest.colours.insert(rest.colours.end(), {c.colours[3 * i], c.colours[3 * i + 1], c.colours[3 * i + 2]});
  }
  expect(rest.densities.size() < c.densities.size(), "some are not reached");
  const auto left = composite_on_cpu<float>(rest);
  expect_same_bits("colour of what is reached", left.colour, all.colour);
  expect_same_bits("transmittance of what is reached", left.transmittance, all.transmittance);
}

void test_known_rays() {
  SampleCase c = sample_case({3, 3, 0}, 1, 1e-4);
  c.densities = {0, 1e9, 1, 0, 0, 0};
  auto found = composite_on_cpu<float>(c);
  expect(found.transmittance == std::vector<float>{0, 1, 1}, "a wall, air, and nothing at all");
  for (int k = 0; k < 3; ++k) expect(found.colour[k] == as<float>(c.colours)[3 + k], "a wall has its own colour");
  expect(found.depth[1] == 0 && found.depth[2] == 0 && found.colour[8] == 0, "nothing is seen in air");
  expect(found.weights == std::vector<float>{0, 1, 0, 0, 0, 0}, "the wall alone counts");

  c.densities = {0.5, 0.5, 0.25, kNone, 0.5, 0.5}, c.ends[2] = 1e10;  // NeRF's last sample
  found = composite_on_cpu<float>(c);
  for (int i = 0; i < 6; ++i) expect(std::isfinite(found.by_densities[i]) == (i < 3), "NaN stays in its own ray");
  expect(found.transmittance[0] == 0 && found.by_densities[2] == 0, "nothing passes a sample without end");
}

}  // namespace

int main() {
  skip_unless_supported();
  for (const int64_t features : {1, 2, 4, 8}) test_hash_grid(features);
  test_hash_grid_threads(), test_samples_of_a_level(), test_points_outside(), test_nan_points_and_rows(),
      test_no_points();
  test_march(1), test_march(3), test_growing_samples<double>(1e-11), test_growing_samples<float>(1e-5);
  test_march_threads<float>(), test_march_threads<double>(), test_degenerate_rays<float>(),
      test_degenerate_rays<double>();
  test_composition(0.5, 0), test_composition(3, 0.01), test_composition_threads();
  test_reached_samples_only(), test_known_rays();
  return report();
}

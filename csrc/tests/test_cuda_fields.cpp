// The CUDA kernels of radiance fields, run by the emulation of cuda_on_cpu.hpp with all its checks, or on a GPU: against the
// CPU's in float64, and bit by bit against themselves under other orders of blocks and threads.
#include <algorithm>
#include <cmath>
#include <limits>

#include "tests/check.hpp"
#include "tests/fields.hpp"
#include "tests/gpu.hpp"

namespace {

using namespace dyngs;
using namespace check;

constexpr double kNone = std::numeric_limits<double>::quiet_NaN();

// Hash grids ----------------------------------------------------------------------------------------------------------

GridResults<float> grid_on_gpu(const GridCase& c, int64_t at_once = cuda::kHashSamples) {
  Memory<float> coords(as<float>(c.coords)), table(as<float>(c.table)), weights(as<float>(c.weights));
  Memory<float> features(weights.count()), by_table(table.count());
  const HashGrid<float> grid{c.levels, c.features, coords.get(), c.count(), 1};
  Memory<char> workspace(cuda::hash_grid_backward_workspace(grid, at_once));
  cuda::hash_grid_forward(grid, table.get(), features.get(), nullptr);
  cuda::hash_grid_backward(grid, weights.get(), by_table.get(), {workspace.get(), workspace.count()}, nullptr, at_once);
  return {features.values(), by_table.values()};
}

// `around`: where points lie, see grid_case; a small one puts most into few rows, which whole blocks add up.
void test_hash_grid(const std::vector<HashLevel>& levels, int64_t features, int64_t count, double around) {
  const GridCase c = grid_case(levels, features, count, around);
  const std::string what = std::to_string(features) + " features, " + std::to_string(count) + " points";
  const auto cpu = grid_on_cpu<double>(c);
  const auto gpu = grid_on_gpu(c);
  expect_close("features, " + what, gpu.features, cpu.features, 2e-5);
  expect_close("gradient, " + what, gpu.by_table, cpu.by_table, 2e-5);
  in_other_orders([&] {
    const auto again = grid_on_gpu(c);
    expect_same_bits("features again, " + what, again.features, gpu.features);
    expect_same_bits("gradient again, " + what, again.by_table, gpu.by_table);
  });
  for (const int64_t at_once : {count / 3, count - 1})
    expect_close("gradient in parts, " + what, grid_on_gpu(c, at_once).by_table, cpu.by_table, 2e-5);
}

void test_points_outside_and_nan() {
  const auto levels = levels_of({1, 4, 30}, 256);
  GridCase c = grid_case(levels, 2, 70, 3.0);
  c.coords[3 * 7 + 1] = kNone, c.coords[0] = 1e30, c.table[2] = kNone;
  const auto gpu = grid_on_gpu(c), cpu = grid_on_cpu<float>(c);
  for (size_t i = 0; i < gpu.features.size(); ++i)
    expect(std::isnan(cpu.features[i]) == std::isnan(gpu.features[i]), "NaN of points and rows, where the CPU has it");
  for (size_t i = 0; i < gpu.by_table.size(); ++i)
    expect(std::isnan(cpu.by_table[i]) == std::isnan(gpu.by_table[i]), "NaN of gradients, where the CPU has it");
  expect(std::isnan(gpu.features[6 * 7]) && !std::isnan(gpu.features[6 * 8]), "NaN is where it belongs");
}

void test_no_points() {
  const auto gpu = grid_on_gpu(grid_case(levels_of({4, 30}, 256), 2, 0));
  expect(std::all_of(gpu.by_table.begin(), gpu.by_table.end(), [](float x) { return x == 0; }), "no points");
}

// Marching ------------------------------------------------------------------------------------------------------------

Marched<float> march_on_gpu(const MarchCase& c) {
  const auto cells = cells_of(c);
  Memory<bool> occupied(c.occupied);
  Memory<float> origins(as<float>(c.origins)), directions(as<float>(c.directions)), shifts(as<float>(c.shifts));
  const March<float> march{single(c.space),
                           occupied.get(),
                           origins.get(),
                           directions.get(),
                           shifts.get(),
                           c.rays(),
                           static_cast<float>(c.near),
                           static_cast<float>(c.step),
                           static_cast<float>(c.cone),
                           c.most,
                           1};
  Memory<int64_t> counts(c.rays());
  cuda::march_count(march, counts.get(), nullptr);
  const auto sums = sums_of(counts.values());
  Memory<int64_t> offsets(sums);
  Memory<int32_t> rays(sums.back());
  Memory<float> starts(sums.back()), ends(sums.back()), coords(3 * sums.back());
  cuda::march_samples(march, offsets.get(), {rays.get(), starts.get(), ends.get(), coords.get()}, nullptr);
  return {sums, rays.values(), starts.values(), ends.values(), coords.values()};
}

void test_march(int64_t cascades, double cone) {
  const MarchCase c = march_case(300, cascades, cone);
  const auto gpu = march_on_gpu(c);
  const auto cpu = march_on_cpu<double>(c);
  const std::string what = ", " + std::to_string(cascades) + " cubes";
  // float32 puts a middle that is nearly on a wall into the other cell now and then
  int64_t other = 0;
  Values wanted[3];
  std::vector<float> found[3];
  for (int64_t ray = 0; ray < c.rays(); ++ray) {
    const int64_t at = gpu.offsets[ray], end = gpu.offsets[ray + 1], on_cpu = cpu.offsets[ray];
    if (end - at != cpu.offsets[ray + 1] - on_cpu) {
      ++other;
      continue;
    }
    for (int64_t i = at; i < end; ++i) {
      expect(gpu.rays[i] == ray, "samples of a ray lie together" + what);
      const int64_t k = on_cpu + i - at;
      found[0].push_back(gpu.starts[i]), wanted[0].push_back(cpu.starts[k]);
      found[1].push_back(gpu.ends[i]), wanted[1].push_back(cpu.ends[k]);
      for (int a = 0; a < 3; ++a) found[2].push_back(gpu.coords[3 * i + a]), wanted[2].push_back(cpu.coords[3 * k + a]);
    }
  }
  expect(other <= c.rays() / 100, std::to_string(other) + " rays have another number of samples" + what);
  expect(found[0].size() > 1000, "samples enough" + what);
  expect_close("starts" + what, found[0], wanted[0], 1e-5);
  expect_close("ends" + what, found[1], wanted[1], 1e-5);
  expect_close("coordinates" + what, found[2], wanted[2], 1e-5);
  in_other_orders([&] {
    const auto again = march_on_gpu(c);
    expect(again.offsets == gpu.offsets && again.rays == gpu.rays, "samples again" + what);
    expect_same_bits("starts again" + what, again.starts, gpu.starts);
    expect_same_bits("coordinates again" + what, again.coords, gpu.coords);
  });
}

// From nowhere, of no direction, along an edge, from so far away that a step is lost in rounding, and past the cube.
void test_degenerate_rays() {
  MarchCase c{{{0, 0, 0}, 1, 1, 4}, std::vector<bool>(64, true), {}, {}, Values(6, 0.25), 0, 0.125, 0, 100};
  c.origins = {kNone, 0, 0, 0, 0, 0, -5, 1, 1, -1e9, 0, 0, -5, 0.125, 2, -5, 0.125, 0.25};
  for (const double x : {1, 0, 1, 1, 1, 1}) c.directions.insert(c.directions.end(), {x, 0, 0});
  const auto gpu = march_on_gpu(c);
  expect(gpu.offsets == march_on_cpu<float>(c).offsets, "hard rays have as many samples as on the CPU");
  expect(gpu.offsets[6] - gpu.offsets[5] == 16 && gpu.offsets[1] == 0, "the last one goes through the whole cube");
  c.occupied.assign(64, false);
  expect(march_on_gpu(c).offsets.back() == 0, "an empty cube");
  c.origins = c.directions = c.shifts = {};
  expect(march_on_gpu(c).offsets.back() == 0, "no rays");
}

// Compositing ---------------------------------------------------------------------------------------------------------

Composition<float> composite_on_gpu(const SampleCase& c) {
  Memory<float> densities(as<float>(c.densities)), colours(as<float>(c.colours)), starts(as<float>(c.starts));
  Memory<float> ends(as<float>(c.ends)), g_colour(as<float>(c.g_colour)), g_depth(as<float>(c.g_depth));
  Memory<float> g_transmittance(as<float>(c.g_transmittance));
  Memory<int64_t> offsets(c.offsets);
  Memory<float> colour(3 * c.rays()), transmittance(c.rays()), depth(c.rays()), weights(densities.count());
  Memory<float> by_densities(densities.count()), by_colours(colours.count());
  Memory<bool> reached(densities.count());
  Memory<int64_t> counts(c.rays());
  const RaySamples<float> in{densities.get(),
                             colours.get(),
                             starts.get(),
                             ends.get(),
                             offsets.get(),
                             c.rays(),
                             static_cast<float>(c.transmittance_min),
                             1};
  cuda::composite_forward(in, {colour.get(), transmittance.get(), depth.get(), weights.get()}, nullptr);
  cuda::composite_backward(in, {g_colour.get(), g_transmittance.get(), g_depth.get(), nullptr}, by_densities.get(),
                           by_colours.get(), nullptr);
  const RaySamples<float> uncoloured{densities.get(), nullptr,  starts.get(),         ends.get(),
                                     offsets.get(),   c.rays(), in.transmittance_min, 1};
  cuda::reached_samples(uncoloured, reached.get(), counts.get(), nullptr);
  const std::vector<bool> flags = reached.values();
  return {colour.values(),     transmittance.values(),       depth.values(), weights.values(), by_densities.values(),
          by_colours.values(), {flags.begin(), flags.end()}, counts.values()};
}

void test_composition(double density, double transmittance_min) {
  const SampleCase c = sample_case(varied_counts(300), density, transmittance_min);
  const std::string what = ", density " + std::to_string(density);
  const auto cpu = composite_on_cpu<double>(c);
  const auto gpu = composite_on_gpu(c);
  expect_close("colour" + what, gpu.colour, cpu.colour, 2e-6);
  expect_close("transmittance" + what, gpu.transmittance, cpu.transmittance, 2e-6);
  expect_close("depth" + what, gpu.depth, cpu.depth, 2e-6);
  expect_close("weights" + what, gpu.weights, cpu.weights, 2e-6);
  expect_close("gradient by densities" + what, gpu.by_densities, cpu.by_densities, 1e-5);
  expect_close("gradient by colours" + what, gpu.by_colours, cpu.by_colours, 2e-6);
  expect(gpu.reached == cpu.reached && gpu.counts == cpu.counts, "which are reached" + what);
  in_other_orders([&] {
    const auto again = composite_on_gpu(c);
    expect_same_bits("colour again" + what, again.colour, gpu.colour);
    expect_same_bits("gradient by densities again" + what, again.by_densities, gpu.by_densities);
    expect_same_bits("gradient by colours again" + what, again.by_colours, gpu.by_colours);
  });
}

void test_known_rays() {
  SampleCase c = sample_case({3, 3, 0}, 1, 1e-4);
  c.densities = {0.5, 0.5, 0.25, kNone, 0.5, 0.5}, c.ends[2] = 1e10;  // NeRF's last sample
  const auto gpu = composite_on_gpu(c);
  for (int i = 0; i < 6; ++i) expect(std::isfinite(gpu.by_densities[i]) == (i < 3), "NaN stays in its own ray");
  expect(gpu.transmittance[0] == 0 && gpu.transmittance[2] == 1, "a ray of an endless sample, and one of none");
  expect(gpu.by_densities[2] == 0, "nothing passes a sample without end");
  expect(composite_on_gpu(sample_case({}, 1, 0)).colour.empty(), "no rays");
}

}  // namespace

int main() {
  skip_without_gpu();
  const auto levels = levels_of({3, 6, 17, 24}, 512);
  test_hash_grid(levels, 4, 700, 0.6), test_hash_grid(levels, 1, 60, 0.6), test_hash_grid(levels, 8, 90, 0.6);
  test_hash_grid(levels_of({2, 40}, 256), 2, 900, 0.01);
  test_points_outside_and_nan(), test_no_points();
  test_march(1, 0), test_march(3, 0.0625), test_degenerate_rays();
  test_composition(0.5, 0), test_composition(3, 0.01), test_known_rays();
  return report();
}

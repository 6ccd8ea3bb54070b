// The CUDA kernels from Gaussians to images and back, run by the emulation of cuda_on_cpu.hpp with all its checks, or on a GPU
// (tests/GPU.hpp): against the CPU's kernels in float64 and float32, and bit by bit against themselves under other orders of
// blocks and threads.
#include <functional>

#include "tests/scene_on_gpu.hpp"

namespace {

using namespace check;

// The same tiles and the same order as the CPU's lists. Slots are numbers of places: contiguous for each splat, each once.
void expect_same_lists(const std::string& what, const Binning& gpu, const Binning& cpu) {
  expect_same_bits("tile offsets, " + what, gpu.tile_offsets, cpu.tile_offsets);
  expect_same_bits("entries, " + what, gpu.gaussians, cpu.gaussians);
  std::vector<int> used(gpu.slots.size());
  bool own = true;
  for (size_t i = 0; i < gpu.slots.size(); ++i) {
    const int32_t slot = gpu.slots[i], row = gpu.gaussians[i];
    ++used[slot];
    own &= gpu.slot_ranges[2 * row] <= slot && slot < gpu.slot_ranges[2 * row + 1];
  }
  int64_t covered = 0;
  for (size_t row = 0; row < gpu.slot_ranges.size() / 2; ++row)
    covered += gpu.slot_ranges[2 * row + 1] - gpu.slot_ranges[2 * row];
  expect(own, "every slot lies in its splat's range, " + what);
  expect(std::all_of(used.begin(), used.end(), [](int n) { return n == 1; }), "every slot is used once, " + what);
  expect(covered == static_cast<int64_t>(gpu.slots.size()), "ranges cover the slots, " + what);
}

// Lists for splats that the CPU projected, so that both start from the same bits.
void test_tile_lists(const std::string& what, const Scene& s) {
  const Inputs<float> in(s, 1);
  Drawn<float> d;
  project_all(in, d);
  GpuSplats held(d);
  expect_same_lists(what, bin_on_gpu(held.splats(in, d)), bin_tiles(in.splats(d), kNoLimit));
}

void expect_same_drawing(const std::string& what, const Drawn<float>& a, const Drawn<float>& b) {
  expect_same_bits("means2d, " + what, a.means2d, b.means2d);
  expect_same_bits("image, " + what, a.color, b.color);
  expect_same_bits("stop, " + what, a.stop, b.stop);
  expect_same_bits("probe, " + what, a.probe, b.probe);
  expect_same_bits("means gradient, " + what, a.g_means, b.g_means);
  expect_same_bits("quats gradient, " + what, a.g_quats, b.g_quats);
  expect_same_bits("scales gradient, " + what, a.g_scales, b.g_scales);
  expect_same_bits("opacities gradient, " + what, a.g_opacities, b.g_opacities);
  expect_same_bits("features gradient, " + what, a.g_features, b.g_features);
  expect_same_bits("sh gradient, " + what, a.g_sh, b.g_sh);
  expect_same_bits("centers gradient, " + what, a.g_centers, b.g_centers);
  expect_same_bits("viewmats gradient, " + what, a.g_viewmats, b.g_viewmats);
  expect_same_bits("intrinsics gradient, " + what, a.g_intrinsics, b.g_intrinsics);
  for (int k = 0; k < 4; ++k) expect_same_bits("tally, " + what, a.tallies[k], b.tallies[k]);
}

// expect_close, but where all expected values are zero up to rounding, so must be all results.
template <class A, class B>
void expect_as(const std::string& what, const std::vector<A>& got, const std::vector<B>& wanted, double tolerance) {
  const auto is_nothing = [](auto x) { return std::abs(static_cast<double>(x)) < 1e-15; };
  if (!std::all_of(wanted.begin(), wanted.end(), is_nothing)) return expect_close(what, got, wanted, tolerance);
  expect(got.size() == wanted.size() && std::all_of(got.begin(), got.end(), is_nothing), what + " is zero");
}

// To which share of the largest value.
struct Tolerance {
  double image = 2e-5, gradient = 2e-4;  // those that float32 on the CPU is held to (test_render.cpp)
};

// `GPU` against the CPU.
template <class S>
void expect_as_cpu(const std::string& what, const Scene& s, const Drawn<float>& gpu, const Drawn<S>& cpu,
                   const Tolerance& to) {
  expect_as("means2d, " + what, gpu.means2d, cpu.means2d, 1e-6);
  expect_as("factors, " + what, gpu.factors, cpu.factors, to.image);
  expect_as("compensations, " + what, gpu.compensations, cpu.compensations, to.image);
  expect_as("colours, " + what, gpu.colors, cpu.colors, 2e-6);
  expect_as("image, " + what, gpu.color, cpu.color, to.image);
  expect_as("transmittance, " + what, gpu.transmittance, cpu.transmittance, to.image);
  expect_as("means gradient, " + what, gpu.g_means, cpu.g_means, to.gradient);
  expect_as("quats gradient, " + what, gpu.g_quats, cpu.g_quats, to.gradient);
  expect_as("scales gradient, " + what, gpu.g_scales, cpu.g_scales, to.gradient);
  expect_as("opacities gradient, " + what, gpu.g_opacities, cpu.g_opacities, to.gradient);
  expect_as("features gradient, " + what, gpu.g_features, cpu.g_features, to.gradient);
  expect_as("probe, " + what, gpu.probe, cpu.probe, to.gradient);
  expect_as("viewmats gradient, " + what, gpu.g_viewmats, cpu.g_viewmats, to.gradient);
  expect_as("intrinsics gradient, " + what, gpu.g_intrinsics, cpu.g_intrinsics, to.gradient);
  for (int k :
       {0, 3})  // not the pixels counted: in float more weights round to zero; nor the lanes: warps are not blocks
    expect_as("tally " + std::to_string(k) + ", " + what, gpu.tallies[k], cpu.tallies[k], to.gradient);
  if (s.channels != 3) return;
  expect_as("sh gradient, " + what, gpu.g_sh, cpu.g_sh, to.gradient);
  expect_as("centers gradient, " + what, gpu.g_centers, cpu.g_centers, to.gradient);
}

template <class S = double>
void compare(const std::string& what, const Scene& s, const Tolerance& to = {}) {
  const Cotangents cotangents = random_cotangents(s);
  expect_as_cpu(what, s, draw_on_gpu(s, &cotangents), draw<S>(s, 1, &cotangents), to);
}

Scene with_thresholds(Scene s) {
  s.alpha_min = 1.0 / 255, s.transmittance_min = 1e-4;
  return s;
}

// With thresholds a pixel may fall on the other side by rounding: nearly all are as in float64, and none further off than the
// least alpha that is drawn.
void test_thresholds() {
  const Scene s = with_thresholds(random_scene(120, 41, 35, 3, 0.3));
  const Drawn<float> gpu = draw_on_gpu(s, nullptr);
  const Drawn<double> cpu = draw<double>(s, 1);
  int64_t far = 0;
  double largest = 0;
  for (size_t i = 0; i < gpu.color.size(); ++i) {
    const double error = std::abs(gpu.color[i] - cpu.color[i]);
    if (!(error <= 2e-5)) ++far;
    largest = error <= largest ? largest : error;
  }
  expect(far <= static_cast<int64_t>(gpu.color.size()) / 100, std::to_string(far) + " pixels differ with thresholds");
  expect(largest < 2.0 / 255, "with thresholds no pixel is further off than what is not drawn");
  expect(std::any_of(gpu.stop.begin(), gpu.stop.end(), [](int32_t stop) { return stop < 1000; }),
         "some pixels are full");
}

// Of Gaussians hardly wider than the low-pass, whose compensation decides how far they are seen.
void test_extents() {
  const Scene s = with_thresholds(random_scene(200, 61, 50, 3, 0.01));
  const std::vector<int32_t> gpu = draw_on_gpu(s, nullptr).radii, cpu = draw<float>(s, 1).radii;
  int64_t differ = 0;
  for (size_t i = 0; i < cpu.size(); ++i) differ += gpu[i] != cpu[i] ? 1 : 0;
  expect(differ <= 4, std::to_string(differ) + " extents differ");  // they are rounded up
}

// Gradients with pixels that are full before the last Gaussian, with whole tiles that are, and with a least alpha. Rounding hardly
// ever decides on which side of a threshold a pixel falls, but it may in the last of them.
void test_gradients_with_thresholds() {
  Scene pixels = random_scene(60, 37, 19, 3, 0.2);
  pixels.transmittance_min = 0.05;
  compare("full pixels", pixels);
  for (int channels : {3, 7}) {
    Scene tiles = random_scene(300, 20, 18, channels, 100);
    tiles.transmittance_min = 1e-4, tiles.opacities.assign(tiles.n, 0.5);
    compare("full tiles, D=" + std::to_string(channels), tiles);
  }
  Scene faint = random_scene(60, 37, 19, 3, 0.2);
  faint.alpha_min = 0.05;
  compare("a least alpha", faint, {1e-3, 5e-3});
}

// Without gradients of cameras, probe and background.
void test_parts() {
  const Scene s = random_scene(70, 37, 19, 3, 0.2);
  const Cotangents cotangents = random_cotangents(s);
  const Drawn<float> all = draw_on_gpu(s, &cotangents);
  OnGpu gpu(s);
  gpu.with_cameras = false, gpu.with_probe = false;
  Drawn<float> some = draw_on_gpu(gpu, &cotangents);
  expect(some.probe.empty() && some.g_viewmats.empty() && some.g_centers.empty(), "nothing that was not asked for");
  some.probe = all.probe, some.g_viewmats = all.g_viewmats, some.g_intrinsics = all.g_intrinsics;
  some.g_centers = all.g_centers;
  expect_same_drawing("without cameras and probe", some, all);

  Scene black = s;
  black.background.assign(black.background.size(), 0);
  const Drawn<float> on_black = draw_on_gpu(black, &cotangents);
  OnGpu none(black);
  none.with_background = false;
  expect_same_drawing("without a background", draw_on_gpu(none, &cotangents), on_black);
}

// Every order of blocks and threads gives the same bytes, with and without pixels that are full before the end.
void test_orders() {
  const Scene s = with_thresholds(random_scene(150, 41, 35, 3, 0.3));
  const Cotangents cotangents = random_cotangents(s);
  const Drawn<float> forward = draw_on_gpu(s, &cotangents);
  in_other_orders([&] { expect_same_drawing("in another order", forward, draw_on_gpu(s, &cotangents)); });
}

void test_all_tile_lists() {
  test_tile_lists("thresholds", with_thresholds(random_scene(500, 90, 70, 3, 0.1)));
  test_tile_lists("no thresholds", random_scene(100, 90, 70, 3, 0.1));
  test_tile_lists("several pieces to sort", with_thresholds(random_scene(3000, 75, 50, 3, 0.05)));
  Scene tall =
      with_thresholds(random_scene(60, 33, 900, 3, 0.5));  // 57 tile rows: those of large splats by whole warps
  test_tile_lists("large splats", tall);
  Scene equal = with_thresholds(random_scene(200, 40, 40, 3, 0.2));
  for (int64_t i = 0; i < equal.n; ++i) equal.means[3 * i + 2] = 4;
  for (int k = 0; k < 32; ++k) equal.viewmats[k] = k % 16 % 5 == 0 ? 1 : 0;
  test_tile_lists("equal depths", equal);
  test_tile_lists("more than 65536 tiles", with_thresholds(random_scene(8, 4099, 4200, 3, 0.0002)));
  test_tile_lists("a image of one pixel", random_scene(5, 1, 1, 3, 0.5));
}

#if !defined(DYNGS_ON_GPU)
// The host waits for the GPU once per image, for the number of entries.
void test_host_reads() {
  const Scene s = random_scene(20, 37, 29, 3, 0.3);
  const Cotangents cotangents = random_cotangents(s);
  const int64_t before = cuda::emulated::machine.host_reads;
  draw_on_gpu(s, &cotangents);
  expect(cuda::emulated::machine.host_reads == before + 1, "one number is read back");
}
#endif

void test_limit_of_entries() {
  const Scene s = random_scene(20, 37, 29, 3, 0.3);
  const Inputs<float> in(s, 1);
  Drawn<float> d;
  project_all(in, d);
  GpuSplats held(d);
  std::string message;
  try {
    bin_on_gpu(held.splats(in, d), 3);
  } catch (const std::length_error& error) {
    message = error.what();
  }
  const int64_t count = bin_tiles(in.splats(d), kNoLimit).gaussians.size();
  expect(message ==
             "20 Gaussians in 2 view(s) of 37x29 px meet " + std::to_string(count) + " tiles, more than the limit of 3",
         "more entries than allowed are refused: " + message);
}

void test_empty_scene() {
  Scene s = random_scene(3, 20, 18, 3, 0.1);
  for (int64_t i = 0; i < s.n; ++i) s.means[3 * i + 2] = -5;  // behind the cameras
  compare("behind the cameras", s);
  compare("no Gaussians", random_scene(0, 20, 18, 3, 0.1));
}

// Rows of the table of docs/contributing/numerics.md.
void test_extremes() {
  const auto changed = [](const std::string& what, const std::function<void(Scene&)>& change,
                          const Tolerance& to = {}) {
    Scene s = random_scene(30, 37, 29, 3, 0.2);
    change(s);
    compare(what, s, to);
  };
  const auto scaled = [](double to) {
    return [to](Scene& s) {
      for (double& x : s.scales) x = to;
    };
  };
  const auto turned = [](double by) {
    return [by](Scene& s) {
      for (double& x : s.quats) x = static_cast<float>(x * by);
    };
  };
  const auto plain = [](const std::function<void(Scene&)>& change) {
    return [change](Scene& s) { change(s), s.antialiased = false; };
  };
  changed("scales 1e-12", plain(scaled(1e-12)));
  changed("scales 1e-12, antialiased", scaled(1e-12));
  changed("scales 0", plain(scaled(0)));
  changed("dark colours", [](Scene& s) {  // a third of them clamped to zero
    for (double& x : s.sh) x = static_cast<float>(x * 20);
  });
  changed("scales 1e12", scaled(1e12));
  changed("needles", plain([](Scene& s) {
            for (int64_t i = 0; i < s.n; ++i)
              for (int k = 0; k < 3; ++k) s.scales[3 * i + k] = k == i % 3 ? 1e4 : 1e-4;
          }),
          {2e-5, 1e-3});
  changed("zero quaternions", turned(0));
  for (double by : {1e-3, 1e3, 1e30, 1e-30}) changed("quaternions times " + std::to_string(by), turned(by));
  changed("opacity 0", [](Scene& s) {
    for (double& x : s.opacities) x = 0;
  });
  changed("opacity 1", [](Scene& s) {
    for (double& x : s.opacities) x = 1;
  });
  changed("at the camera and on the near plane", [](Scene& s) {
    for (int64_t i = 0; i < s.n; ++i) s.means[3 * i + 2] = i % 3 == 0 ? 0 : i % 3 == 1 ? 0.2f : 0.25f;
  });
  changed("far away", [](Scene& s) {
    for (double& x : s.means) x = static_cast<float>(x * 20);
    for (double& x : s.scales) x = static_cast<float>(x * 20);
  });
  changed("coincident and opaque", [](Scene& s) {
    for (int64_t i = 0; i < s.n; ++i)
      for (int k = 0; k < 3; ++k) s.means[3 * i + k] = k == 2 ? 4 : 0;
    for (double& x : s.opacities) x = 1;
  });
  Scene thin = random_scene(400, 20, 17, 3, 0.5);
  for (double& x : thin.opacities) x = static_cast<float>(0.01);
  for (int64_t i = 0; i < thin.n; ++i) thin.means[3 * i] = thin.means[3 * i + 1] = 0, thin.means[3 * i + 2] = 4;
  compare("400 coincident of opacity 0.01", thin, {3e-5, 1e-3});
  Scene huge = random_scene(30, 37, 29, 3, 0.2);
  scaled(1e20)(huge);
  compare<float>("scales 1e20", huge);  // culled in float32 alone
  compare("1x1", random_scene(20, 1, 1, 3, 0.3));
  compare("1x700", random_scene(20, 1, 700, 3, 0.3), {2e-5, 1e-3});
  compare("700x1", random_scene(20, 700, 1, 3, 0.3), {2e-5, 1e-3});
}

}  // namespace

int main() {
  skip_without_gpu();
  for (int channels : {1, 3, 4, 7, 13, kMaxChannels})
    compare("D=" + std::to_string(channels), random_scene(40, 37, 19, channels, 0.2));
  test_all_tile_lists();
  test_thresholds();
  test_extents();
  test_gradients_with_thresholds();
  test_parts();
  test_orders();
#if !defined(DYNGS_ON_GPU)
  test_host_reads();
#endif
  test_limit_of_entries();
  test_empty_scene();
  test_extremes();
  return report();
}

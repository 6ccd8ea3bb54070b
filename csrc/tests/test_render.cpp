// The kernels from Gaussians to images and back, as a program without Python: it runs where the module cannot (other
// processors under an emulator, sanitizers). Images against a plain loop over all Gaussians, gradients against central
// differences, float against double, many threads against one. `test_render large` adds a scene that is sorted by
// several threads, too.
#include <cmath>
#include <numeric>

#include "tests/scene.hpp"

namespace {

using namespace dyngs;
using namespace check;

// The image by a loop over all pixels and all Gaussians, nearest first.
Values plain_image(const Scene& s, const Drawn<double>& d) {
  Values color(s.pixels() * s.channels);
  for (int64_t v = 0; v < s.views; ++v) {
    std::vector<int64_t> order(s.n);
    std::iota(order.begin(), order.end(), v * s.n);
    std::stable_sort(order.begin(), order.end(), [&](int64_t a, int64_t b) { return d.depths[a] < d.depths[b]; });
    for (int64_t p = 0; p < int64_t{s.width} * s.height; ++p) {
      double* out = color.data() + (v * s.width * s.height + p) * s.channels;
      const double px = p % s.width + 0.5, py = p / s.width + 0.5;
      double left = 1;
      for (int64_t i : order) {
        if (d.radii[2 * i] == 0) continue;
        const double dx = px - d.means2d[2 * i], dy = py - d.means2d[2 * i + 1];
        const double a = d.factors[3 * i] * dx + d.factors[3 * i + 1] * dy, b = d.factors[3 * i + 2] * dy;
        const double alpha = std::min(0.99, d.opacities[i] * std::exp(-0.5 * (a * a + b * b)));
        if (alpha < s.alpha_min) continue;
        if (left * (1 - alpha) < s.transmittance_min) break;
        for (int c = 0; c < s.channels; ++c) out[c] += alpha * left * d.colors[i * s.channels + c];
        left *= 1 - alpha;
      }
      for (int c = 0; c < s.channels; ++c) out[c] += left * s.background[v * s.channels + c];
    }
  }
  return color;
}

void test_gradients(const Scene& s, const Cotangents& cotangents, const Drawn<double>& d) {
  const auto by = [&](Values Scene::* member) {
    return [&s, &cotangents, member](const Values& x) {
      Scene moved = s;
      moved.*member = x;
      const Drawn<double> drawn = draw<double>(moved, 1);
      return dot(drawn.color, cotangents.color) + dot(drawn.transmittance, cotangents.transmittance) +
             dot(drawn.depths, cotangents.depths);
    };
  };
  const auto test = [&](const char* name, Values Scene::* member, const Values& gradient) {
    expect_gradient(std::string(name) + " gradient, D=" + std::to_string(s.channels), by(member), s.*member, gradient,
                    1e-6, 1e-6, 6);
  };
  test("means", &Scene::means, d.g_means), test("quats", &Scene::quats, d.g_quats);
  test("scales", &Scene::scales, d.g_scales), test("opacities", &Scene::opacities, d.g_opacities);
  Values g_viewmats = d.g_viewmats, viewmats = s.viewmats;
  expect_gradient("viewmats gradient", by(&Scene::viewmats), viewmats, g_viewmats, 1e-6, 1e-6, 16);
  expect_gradient("intrinsics gradient", by(&Scene::intrinsics), s.intrinsics, d.g_intrinsics, 1e-6, 1e-6, 9);
  if (s.channels != 3) return test("features", &Scene::features, d.g_features);
  test("sh", &Scene::sh, d.g_sh), test("centers", &Scene::centers, d.g_centers);
}

// Without thresholds, so that rounding cannot change what is drawn.
void test_small(int channels) {
  const Scene s = random_scene(40, 21, 19, channels, 0.2);
  const Cotangents cotangents = random_cotangents(s);
  const std::string what = "D=" + std::to_string(channels);
  const Drawn<double> d = draw<double>(s, 1, &cotangents);
  expect_close("image, " + what, d.color, plain_image(s, d), 1e-12);
  test_gradients(s, cotangents, d);
  const Drawn<float> f = draw<float>(s, 1, &cotangents);
  expect_close("float image, " + what, f.color, d.color, 2e-5);
  expect_close("float transmittance, " + what, f.transmittance, d.transmittance, 2e-5);
  expect_close("float means gradient, " + what, f.g_means, d.g_means, 2e-4);
  expect_close("float quats gradient, " + what, f.g_quats, d.g_quats, 2e-4);
  expect_close("float scales gradient, " + what, f.g_scales, d.g_scales, 2e-4);
  expect_close("float opacities gradient, " + what, f.g_opacities, d.g_opacities, 2e-4);
  expect_close("float probe, " + what, f.probe, d.probe, 2e-4);
  for (int k : {0, 2, 3})  // not the pixels counted: in float more weights round to zero
    expect_close("float tally " + std::to_string(k), f.tallies[k], d.tallies[k], 2e-4);
  if (channels == 3) expect_close("float sh gradient", f.g_sh, d.g_sh, 2e-4);
}

void test_thresholds() {
  Scene s = random_scene(60, 37, 29, 3, 0.3);
  s.alpha_min = 1.0 / 255, s.transmittance_min = 1e-4;
  const Drawn<double> d = draw<double>(s, 1);
  expect_close("image with thresholds", d.color, plain_image(s, d), 1e-12);
}

template <class S>
void test_threads(int64_t n, double size) {
  Scene s = random_scene(n, 75, 50, 3, size);
  s.alpha_min = 1.0 / 255, s.transmittance_min = 1e-4;
  const Cotangents cotangents = random_cotangents(s);
  const Drawn<S> one = draw<S>(s, 1, &cotangents), four = draw<S>(s, 4, &cotangents);
  const std::string on = " on 4 threads, " + std::to_string(n) + " Gaussians";
  expect_same_bits("image" + on, one.color, four.color);
  expect_same_bits("stop" + on, one.stop, four.stop);
  expect_same_bits("means gradient" + on, one.g_means, four.g_means);
  expect_same_bits("quats gradient" + on, one.g_quats, four.g_quats);
  expect_same_bits("scales gradient" + on, one.g_scales, four.g_scales);
  expect_same_bits("opacities gradient" + on, one.g_opacities, four.g_opacities);
  expect_same_bits("sh gradient" + on, one.g_sh, four.g_sh);
  expect_same_bits("centers gradient" + on, one.g_centers, four.g_centers);
  expect_same_bits("viewmats gradient" + on, one.g_viewmats, four.g_viewmats);
  expect_same_bits("intrinsics gradient" + on, one.g_intrinsics, four.g_intrinsics);
  for (int k = 0; k < 4; ++k) expect_same_bits("tally" + on, one.tallies[k], four.tallies[k]);
}

void test_limit_of_entries() {
  const Scene s = random_scene(20, 37, 29, 3, 0.3);
  const Inputs<float> in(s, 2);
  Drawn<float> d;
  project_all(in, d);
  bool refused = false;
  try {
    bin_tiles(in.splats(d), 3);
  } catch (const std::exception&) {
    refused = true;
  }
  expect(refused, "more entries than allowed are refused");
}

void test_empty_scene() {
  Scene s = random_scene(3, 20, 18, 3, 0.1);
  for (int64_t i = 0; i < s.n; ++i) s.means[3 * i + 2] = -5;  // behind the cameras
  const Cotangents cotangents = random_cotangents(s);
  const Drawn<float> d = draw<float>(s, 2, &cotangents);
  expect(std::all_of(d.transmittance.begin(), d.transmittance.end(), [](float x) { return x == 1; }),
         "nothing is drawn");
  expect(d.color[0] == static_cast<float>(s.background[0]), "an empty image shows the background");
}

}  // namespace

int main(int argc, char** argv) {
  skip_unless_supported();
  for (int channels : {1, 3, 4, 7, kMaxChannels}) test_small(channels);
  test_thresholds();
  test_threads<float>(3000, 0.05), test_threads<double>(500, 0.05);  // spans are shared out beyond 2048
  if (argc > 1 && std::string(argv[1]) == "large") test_threads<float>(300000, 0.003);
  test_limit_of_entries();
  test_empty_scene();
  return report();
}

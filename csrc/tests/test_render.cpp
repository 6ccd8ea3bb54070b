// The kernels from Gaussians to pictures and back, as a program without Python: it runs where the module cannot (other
// processors under an emulator, sanitizers). Pictures against a plain loop over all Gaussians, gradients against central
// differences, float against double, many threads against one. `test_render large` adds a scene that is sorted by
// several threads, too.
#include <cmath>
#include <numeric>

#include "core/api.hpp"
#include "tests/check.hpp"

namespace {

using namespace dyngs;
using namespace check;

struct Scene {
  int64_t n, views;
  int width, height, channels, degree;
  double alpha_min, transmittance_min;
  Values means, quats, scales, opacities, viewmats, intrinsics, centers, sh, features, background;

  int64_t terms() const { return (degree + 1) * (degree + 1); }
  int64_t pixels() const { return views * width * height; }
};

Scene random_scene(int64_t n, int width, int height, int channels, double size) {
  Scene s{n, 2, width, height, channels, 2, 0, 0, {}, {}, {}, {}, {}, {}, {}, {}, {}, {}};
  s.means = uniforms(3 * n, -1, 1);
  for (int64_t i = 0; i < n; ++i) s.means[3 * i + 2] += 4;
  s.quats = uniforms(4 * n, -1, 1), s.scales = uniforms(3 * n, 0.3 * size, size), s.opacities = uniforms(n, 0.2, 0.95);
  s.sh = uniforms(3 * n * s.terms(), -0.1, 0.1), s.features = uniforms(s.views * n * channels, 0, 1);
  s.background = uniforms(s.views * channels, 0, 1), s.centers = uniforms(3 * s.views, -0.2, 0.2);
  for (int64_t v = 0; v < s.views; ++v) {
    const double c = static_cast<float>(std::cos(0.1 * v)), t = static_cast<float>(std::sin(0.1 * v));
    for (double e : {c, 0.0, t, 0.1, 0.0, 1.0, 0.0, -0.1, -t, 0.0, c, 0.2, 0.0, 0.0, 0.0, 1.0}) s.viewmats.push_back(e);
    for (double e : {1.2 * width, 0.0, 0.5 * width, 0.0, 1.3 * width, 0.5 * height, 0.0, 0.0, 1.0})
      s.intrinsics.push_back(static_cast<float>(e));
  }
  return s;
}

constexpr Tally kTallies[] = {Tally::kWeights, Tally::kPixels, Tally::kLanes, Tally::kSquaredSlopes};

// All outputs of the kernels for a scene. Opacities are those that compensate for the low-pass filter.
template <class S>
struct Drawn {
  std::vector<S> means2d, depths, factors, compensations, opacities, colors;
  std::vector<int32_t> radii, stop;
  std::vector<S> color, transmittance, tallies[4];
  std::vector<S> g_means, g_quats, g_scales, g_viewmats, g_intrinsics, g_opacities, g_sh, g_centers, g_features, probe;
};

// The scene's arrays in the scalar type of the kernels, and the structs that point into them.
template <class S>
struct Inputs {
  const Scene& scene;
  int threads;
  std::vector<S> means, quats, scales, opacities, viewmats, intrinsics, centers, sh, background;

  Inputs(const Scene& s, int threads_)
      : scene(s),
        threads(threads_),
        means(as<S>(s.means)),
        quats(as<S>(s.quats)),
        scales(as<S>(s.scales)),
        opacities(as<S>(s.opacities)),
        viewmats(as<S>(s.viewmats)),
        intrinsics(as<S>(s.intrinsics)),
        centers(as<S>(s.centers)),
        sh(as<S>(s.sh)),
        background(as<S>(s.background)) {}

  GaussianViews<S> views() const {
    return {scene.n,       scene.views,      means.data(),    quats.data(),
            scales.data(), opacities.data(), viewmats.data(), intrinsics.data()};
  }
  ProjectOptions<S> options() const {
    return {scene.width, scene.height, S(0.3), S(0.2), S(100), static_cast<S>(scene.alpha_min), S(0), true, threads};
  }
  Harmonics<S> harmonics(const int32_t* radii) const {
    return {scene.n,      scene.views,  static_cast<int>(scene.terms()),
            scene.degree, means.data(), centers.data(),
            sh.data(),    radii,        threads};
  }
  Splats<S> splats(const Drawn<S>& d) const {
    return {scene.n,          scene.views,
            scene.width,      scene.height,
            scene.channels,   d.means2d.data(),
            d.factors.data(), d.opacities.data(),
            d.depths.data(),  d.colors.data(),
            d.radii.data(),   static_cast<S>(scene.alpha_min),
            S(0.99),          static_cast<S>(scene.transmittance_min),
            threads};
  }
};

template <class S>
void project_all(const Inputs<S>& in, Drawn<S>& d) {
  const Scene& s = in.scene;
  const int64_t rows = s.views * s.n;
  d.means2d.resize(2 * rows), d.depths.resize(rows), d.factors.resize(3 * rows), d.compensations.resize(rows);
  d.radii.resize(2 * rows), d.opacities.resize(rows);
  project_forward(
      in.views(), in.options(),
      Projected<S>{d.means2d.data(), d.depths.data(), d.factors.data(), d.compensations.data(), d.radii.data()});
  for (int64_t i = 0; i < rows; ++i) d.opacities[i] = in.opacities[i % s.n] * d.compensations[i];
  d.colors = as<S>(s.features);
  if (s.channels == 3) harmonics_forward(in.harmonics(d.radii.data()), d.colors.data());
}

// The cotangents: of colour, transmittance and depth.
struct Cotangents {
  Values color, transmittance, depths;
};

Cotangents random_cotangents(const Scene& s) {
  return {uniforms(s.pixels() * s.channels, -1, 1), uniforms(s.pixels(), -1, 1), uniforms(s.views * s.n, -1, 1)};
}

template <class S>
void backward(const Inputs<S>& in, const Entries& entries, const Cotangents& cotangents, Drawn<S>& d) {
  const Scene& s = in.scene;
  const int64_t rows = s.views * s.n;
  const auto g_color = as<S>(cotangents.color), g_transmittance = as<S>(cotangents.transmittance);
  const auto g_depths = as<S>(cotangents.depths);
  std::vector<S> g_means2d(2 * rows), g_factors(3 * rows), g_seen(rows), g_compensations(rows);
  d.g_features.resize(rows * s.channels), d.probe.resize(4 * rows);
  rasterize_backward(
      in.splats(d), entries,
      ImageGrads<S>{g_color.data(), g_transmittance.data(), d.transmittance.data(), d.stop.data(),
                    in.background.data()},
      SplatGrads<S>{g_means2d.data(), g_factors.data(), g_seen.data(), d.g_features.data(), d.probe.data(), true});
  d.g_opacities.assign(s.n, S(0));
  for (int64_t i = 0; i < rows; ++i) {
    d.g_opacities[i % s.n] += g_seen[i] * d.compensations[i];
    g_compensations[i] = g_seen[i] * in.opacities[i % s.n];
  }
  d.g_means.resize(3 * s.n), d.g_quats.resize(4 * s.n), d.g_scales.resize(3 * s.n);
  d.g_viewmats.resize(16 * s.views), d.g_intrinsics.resize(9 * s.views);
  project_backward(in.views(), in.options(), d.radii.data(),
                   ProjectedGrads<S>{g_means2d.data(), g_depths.data(), g_factors.data(), g_compensations.data()},
                   GaussianGrads<S>{d.g_means.data(), d.g_quats.data(), d.g_scales.data(), d.g_viewmats.data(),
                                    d.g_intrinsics.data()});
  if (s.channels != 3) return;
  std::vector<S> by_direction(3 * s.n);
  d.g_sh.resize(s.sh.size()), d.g_centers.resize(3 * s.views);
  harmonics_backward(in.harmonics(d.radii.data()), d.colors.data(), d.g_features.data(), by_direction.data(),
                     d.g_sh.data(), d.g_centers.data());
  for (size_t i = 0; i < by_direction.size(); ++i) d.g_means[i] += by_direction[i];
}

template <class S>
Drawn<S> draw(const Scene& s, int threads, const Cotangents* cotangents = nullptr) {
  const Inputs<S> in(s, threads);
  Drawn<S> d;
  project_all(in, d);
  const Splats<S> splats = in.splats(d);
  const Binning bins = bin_tiles(splats, std::numeric_limits<int32_t>::max());
  const Entries entries{bins.tile_offsets.data(), bins.slot_ranges.data(), bins.gaussians.data(), bins.slots.data(),
                        static_cast<int64_t>(bins.gaussians.size())};
  d.color.resize(s.pixels() * s.channels), d.transmittance.resize(s.pixels()), d.stop.resize(s.pixels());
  rasterize_forward(
      splats, entries,
      Image<S>{d.color.data(), d.transmittance.data(), d.stop.data(), in.background.data(), nullptr, Tally::kNone});
  if (cotangents == nullptr) return d;
  backward(in, entries, *cotangents, d);
  auto color = d.color, transmittance = d.transmittance;  // a tally draws again
  auto stop = d.stop;
  for (int k = 0; k < 4; ++k) {
    d.tallies[k].resize(s.views * s.n);
    rasterize_forward(splats, entries,
                      Image<S>{color.data(), transmittance.data(), stop.data(), in.background.data(),
                               d.tallies[k].data(), kTallies[k]});
  }
  return d;
}

// The picture by a loop over all pixels and all Gaussians, nearest first.
Values plain_picture(const Scene& s, const Drawn<double>& d) {
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
  expect_close("picture, " + what, d.color, plain_picture(s, d), 1e-12);
  test_gradients(s, cotangents, d);
  const Drawn<float> f = draw<float>(s, 1, &cotangents);
  expect_close("float picture, " + what, f.color, d.color, 2e-5);
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
  expect_close("picture with thresholds", d.color, plain_picture(s, d), 1e-12);
}

template <class S>
void test_threads(int64_t n, double size) {
  Scene s = random_scene(n, 75, 50, 3, size);
  s.alpha_min = 1.0 / 255, s.transmittance_min = 1e-4;
  const Cotangents cotangents = random_cotangents(s);
  const Drawn<S> one = draw<S>(s, 1, &cotangents), four = draw<S>(s, 4, &cotangents);
  const std::string on = " on 4 threads, " + std::to_string(n) + " Gaussians";
  expect_same_bits("picture" + on, one.color, four.color);
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

void test_nothing_to_draw() {
  Scene s = random_scene(3, 20, 18, 3, 0.1);
  for (int64_t i = 0; i < s.n; ++i) s.means[3 * i + 2] = -5;  // behind the cameras
  const Cotangents cotangents = random_cotangents(s);
  const Drawn<float> d = draw<float>(s, 2, &cotangents);
  expect(std::all_of(d.transmittance.begin(), d.transmittance.end(), [](float x) { return x == 1; }),
         "nothing is drawn");
  expect(d.color[0] == static_cast<float>(s.background[0]), "an empty picture shows the background");
}

}  // namespace

int main(int argc, char** argv) {
  skip_unless_supported();
  for (int channels : {1, 3, 4, 7, kMaxChannels}) test_small(channels);
  test_thresholds();
  test_threads<float>(3000, 0.05), test_threads<double>(500, 0.05);  // spans are shared out beyond 2048
  if (argc > 1 && std::string(argv[1]) == "large") test_threads<float>(300000, 0.003);
  test_limit_of_entries();
  test_nothing_to_draw();
  return report();
}

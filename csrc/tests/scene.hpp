// Random scenes, and all kernels of the CPU run on one, forward and backward.
#pragma once

#include <cmath>
#include <limits>

#include "core/api.hpp"
#include "tests/check.hpp"

namespace check {

using namespace dyngs;

struct Scene {
  int64_t n, views;
  int width, height, channels, degree;
  double alpha_min, transmittance_min;
  Values means, quats, scales, opacities, viewmats, intrinsics, centers, sh, features, background;
  bool antialiased = true;  // opacities compensate for the low-pass filter

  int64_t terms() const { return (degree + 1) * (degree + 1); }
  int64_t pixels() const { return views * width * height; }
};

inline Scene random_scene(int64_t n, int width, int height, int channels, double size) {
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

inline constexpr Tally kTallies[] = {Tally::kWeights, Tally::kPixels, Tally::kLanes, Tally::kSquaredSlopes};

// All outputs of the kernels for a scene.
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
    return {scene.width, scene.height,      S(0.3), S(0.2), S(100), static_cast<S>(scene.alpha_min),
            S(0),        scene.antialiased, threads};
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
  for (int64_t i = 0; i < rows; ++i)
    d.opacities[i] = in.opacities[i % s.n] * (s.antialiased ? d.compensations[i] : S(1));
  d.colors = as<S>(s.features);
  if (s.channels == 3) harmonics_forward(in.harmonics(d.radii.data()), d.colors.data());
}

// The cotangents: of colour, transmittance and depth.
struct Cotangents {
  Values color, transmittance, depths;
};

inline Cotangents random_cotangents(const Scene& s) {
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
    d.g_opacities[i % s.n] += g_seen[i] * (s.antialiased ? d.compensations[i] : S(1));
    g_compensations[i] = s.antialiased ? g_seen[i] * in.opacities[i % s.n] : S(0);
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

}  // namespace check

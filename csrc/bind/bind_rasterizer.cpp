// Python bindings of projection, harmonics, binning and rasterization. Argument unpacking only: arrays come in contiguous
// and of the right shape from dyngs/ops, which also allocates every output.
#include <nanobind/stl/string.h>

#include <algorithm>

#include "bind/arrays.hpp"
#include "bind/results.hpp"
#include "core/api.hpp"
#include "core/triangles.hpp"
#include "cpu/memory.hpp"

namespace dyngs {
namespace {

template <class A>
void expect_rank(const A& array, size_t rank, const char* name) {
  if (array.ndim() != rank)
    throw nb::value_error(
        (std::string(name) + " has " + std::to_string(array.ndim()) + " axes, expected " + std::to_string(rank))
            .c_str());
}

// A image's side, or a number of threads.
int within(int64_t value, int64_t most, const char* name) {
  if (value < 1 || value > most)
    throw nb::value_error(
        (std::string(name) + " is " + std::to_string(value) + ", expected 1 to " + std::to_string(most)).c_str());
  return static_cast<int>(value);
}
constexpr int64_t kMaxThreads = 1 << 16;

struct ProjectSettings {
  int width, height;
  double eps2d, near, far, alpha_min, radius_clip;
  bool antialiased;
  int threads;

  template <class S>
  ProjectOptions<S> cast() const {
    return {width,
            height,
            static_cast<S>(eps2d),
            static_cast<S>(near),
            static_cast<S>(far),
            static_cast<S>(alpha_min),
            static_cast<S>(radius_clip),
            antialiased,
            threads};
  }
};

struct BlendSettings {
  int width, height;
  double alpha_min, alpha_max, transmittance_min;
  int threads;
};

template <class S>
struct GaussianArrays {
  Array<const S> means, quats, scales, opacities, viewmats, intrinsics;

  GaussianViews<S> views() const {
    expect_rank(means, 2, "means"), expect_rank(viewmats, 3, "viewmats");
    const int64_t n = means.shape(0), v = viewmats.shape(0);
    return {n,
            v,
            checked(means, 3 * n, "means"),
            checked(quats, 4 * n, "quats"),
            checked(scales, 3 * n, "scales"),
            checked(opacities, n, "opacities"),
            checked(viewmats, 16 * v, "viewmats"),
            checked(intrinsics, 9 * v, "intrinsics")};
  }
};

template <class S>
void bind_projection(nb::module_& module, const char* arrays_name) {
  using Arrays = GaussianArrays<S>;
  nb::class_<Arrays>(module, arrays_name)
      .def(nb::init<Array<const S>, Array<const S>, Array<const S>, Array<const S>, Array<const S>, Array<const S>>(),
           nb::arg().noconvert(), nb::arg().noconvert(), nb::arg().noconvert(), nb::arg().noconvert(),
           nb::arg().noconvert(), nb::arg().noconvert());
  module.def(
      "project_forward",
      [](const Arrays& in, const ProjectSettings& settings, Array<S> means2d, Array<S> depths, Array<S> factors,
         Array<S> compensations, Array<int32_t> radii) {
        const GaussianViews<S> views = in.views();
        const int64_t rows = views.num_views * views.num_gaussians;
        const Projected<S> out{checked(means2d, 2 * rows, "means2d"), checked(depths, rows, "depths"),
                               checked(factors, 3 * rows, "factors"), checked(compensations, rows, "compensations"),
                               checked(radii, 2 * rows, "radii")};
        nb::gil_scoped_release release;
        project_forward(views, settings.cast<S>(), out);
      },
      nb::arg(), nb::arg(), nb::arg().noconvert(), nb::arg().noconvert(), nb::arg().noconvert(), nb::arg().noconvert(),
      nb::arg().noconvert());
  module.def("project_backward", [](const Arrays& in, const ProjectSettings& settings, Array<const int32_t> radii,
                                    std::tuple<Array<const S>, Array<const S>, Array<const S>, Array<const S>> grads,
                                    std::tuple<Array<S>, Array<S>, Array<S>, MaybeArray<S>, MaybeArray<S>> out) {
    const GaussianViews<S> views = in.views();
    const int64_t n = views.num_gaussians, rows = views.num_views * n;
    const auto& [g_means2d, g_depths, g_factors, g_compensations] = grads;
    const auto& [means, quats, scales, viewmats, intrinsics] = out;
    if (viewmats.has_value() != intrinsics.has_value())
      throw nb::value_error("project_backward: the gradients of viewmats and intrinsics go together");
    const int32_t* sizes = checked(radii, 2 * rows, "radii");
    const ProjectedGrads<S> from{
        checked(g_means2d, 2 * rows, "means2d gradient"), checked(g_depths, rows, "depths gradient"),
        checked(g_factors, 3 * rows, "factors gradient"), checked(g_compensations, rows, "compensations gradient")};
    const GaussianGrads<S> to{checked(means, 3 * n, "means gradient"), checked(quats, 4 * n, "quats gradient"),
                              checked(scales, 3 * n, "scales gradient"),
                              checked(viewmats, 16 * views.num_views, "viewmats gradient"),
                              checked(intrinsics, 9 * views.num_views, "intrinsics gradient")};
    nb::gil_scoped_release release;
    project_backward(views, settings.cast<S>(), sizes, from, to);
  });
}

template <class S>
Harmonics<S> harmonics_input(const Array<const S>& means, const Array<const S>& centers, const Array<const S>& sh,
                             const Array<const int32_t>& radii, int degree, int threads) {
  expect_rank(means, 2, "means"), expect_rank(centers, 2, "centers"), expect_rank(sh, 3, "sh");
  const int64_t n = means.shape(0), v = centers.shape(0);
  const int terms = static_cast<int>(sh.shape(1));
  if (degree < 0 || degree > 4 || (degree + 1) * (degree + 1) > terms)
    throw nb::value_error("harmonics: degree does not fit the stored terms");
  return {n,
          v,
          terms,
          degree,
          checked(means, 3 * n, "means"),
          checked(centers, 3 * v, "centers"),
          checked(sh, n * terms * 3, "sh"),
          checked(radii, 2 * v * n, "radii"),
          threads};
}

template <class S>
void bind_harmonics(nb::module_& module) {
  module.def("harmonics_forward", [](Array<const S> means, Array<const S> centers, Array<const S> sh,
                                     Array<const int32_t> radii, Array<S> colors, int degree, int threads) {
    const Harmonics<S> in = harmonics_input(means, centers, sh, radii, degree, threads);
    S* to = checked(colors, 3 * in.num_views * in.num_gaussians, "colors");
    nb::gil_scoped_release release;
    harmonics_forward(in, to);
  });
  module.def(
      "harmonics_backward", [](Array<const S> means, Array<const S> centers, Array<const S> sh,
                               Array<const int32_t> radii, std::tuple<Array<const S>, Array<const S>> colors_and_grads,
                               std::tuple<Array<S>, Array<S>, MaybeArray<S>> out, int degree, int threads) {
        const Harmonics<S> in = harmonics_input(means, centers, sh, radii, degree, threads);
        const auto& [colors, grads] = colors_and_grads;
        const auto& [g_means, g_sh, g_centers] = out;
        const int64_t n = in.num_gaussians, v = in.num_views;
        const S *forward = checked(colors, 3 * v * n, "colors"), *from = checked(grads, 3 * v * n, "colors gradient");
        S* to_means = checked(g_means, 3 * n, "means gradient");
        S* to_sh = checked(g_sh, 3 * n * in.num_terms, "sh gradient");
        S* to_centers = checked(g_centers, 3 * v, "centers gradient");
        nb::gil_scoped_release release;
        harmonics_backward(in, forward, from, to_means, to_sh, to_centers);
      });
}

template <class S>
struct SplatArrays {
  Array<const S> means2d, factors, opacities;
  Array<const int32_t> radii;

  Splats<S> splats(const BlendSettings& settings) const {
    expect_rank(opacities, 2, "opacities");
    const int64_t v = opacities.shape(0), n = opacities.shape(1);
    return {n,
            v,
            settings.width,
            settings.height,
            0,
            checked(means2d, 2 * v * n, "means2d"),
            checked(factors, 3 * v * n, "factors"),
            opacities.data(),
            nullptr,
            nullptr,
            checked(radii, 2 * v * n, "radii"),
            static_cast<S>(settings.alpha_min),
            static_cast<S>(settings.alpha_max),
            static_cast<S>(settings.transmittance_min),
            settings.threads};
  }

  Splats<S> with_colors(const BlendSettings& settings, const Array<const S>& colors) const {
    Splats<S> s = splats(settings);
    expect_rank(colors, 3, "colors");
    if (colors.shape(2) < 1 || colors.shape(2) > kMaxChannels) throw nb::value_error("rasterize: 1 to 40 channels");
    s.channels = static_cast<int>(colors.shape(2));
    s.colors = checked(colors, s.num_views * s.num_gaussians * s.channels, "colors");
    return s;
  }
};

using EntryArrays = std::tuple<Array<const int64_t>, Array<const int32_t>, Array<const int32_t>, Array<const int32_t>>;

// True if all of `count` indices are in [0, bound).
bool all_within(const int32_t* indices, int64_t count, int64_t bound) {
  uint32_t largest = 0;  // negative indices are larger than any other
  for (int64_t i = 0; i < count; ++i) largest = std::max(largest, static_cast<uint32_t>(indices[i]));
  return count == 0 || largest < static_cast<uint64_t>(bound);
}

// True if all ranges of the lists of tiles and splats are ascending and within the list of entries.
bool in_order(const Entries& e, int64_t tiles, int64_t splats) {
  bool good = e.tile_offsets[0] >= 0 && e.tile_offsets[tiles] <= e.count;
  for (int64_t t = 0; t < tiles; ++t) good &= e.tile_offsets[t] <= e.tile_offsets[t + 1];
  for (int64_t i = 0; i < splats; ++i)
    good &= 0 <= e.slot_ranges[2 * i] && e.slot_ranges[2 * i] <= e.slot_ranges[2 * i + 1] &&
            e.slot_ranges[2 * i + 1] <= e.count;
  return good;
}

template <class S>
Entries checked_entries(const EntryArrays& arrays, const Splats<S>& s) {
  const auto& [tile_offsets, slot_ranges, gaussians, slots] = arrays;
  const int64_t tiles = s.tiles(), splats = s.num_views * s.num_gaussians;
  const auto count = static_cast<int64_t>(gaussians.size());
  const Entries entries{checked(tile_offsets, tiles + 1, "tile_offsets"),
                        checked(slot_ranges, 2 * splats, "slot_ranges"), gaussians.data(),
                        checked(slots, count, "slots"), count};
  if (kOnGpu) return entries;
  if (!in_order(entries, tiles, splats))
    throw nb::value_error("tile_offsets or slot_ranges name entries that are not there");
  if (!all_within(entries.gaussians, count, splats)) throw nb::value_error("gaussians name splats that are not there");
  if (!all_within(entries.slots, count, count)) throw nb::value_error("slots name places that are not there");
  return entries;
}

template <class S>
void bind_binning(nb::module_& module, const char* arrays_name) {
  using Arrays = SplatArrays<S>;
  nb::class_<Arrays>(module, arrays_name)
      .def(nb::init<Array<const S>, Array<const S>, Array<const S>, Array<const int32_t>>(), nb::arg().noconvert(),
           nb::arg().noconvert(), nb::arg().noconvert(), nb::arg().noconvert());
  module.def("bin_tiles",
             [](const Arrays& in, Array<const S> depths, const BlendSettings& settings, int64_t max_entries) {
               Splats<S> s = in.splats(settings);
               s.depths = checked(depths, s.num_views * s.num_gaussians, "depths");
               return binned(s, max_entries);
             });
}

// The Gaussians of pixels, their patches, their samples, and the radius.
template <class S>
using BoundaryArrays = std::tuple<Array<const int32_t>, Array<const int32_t>, Array<const S>, double>;

template <class S>
Boundaries<S> checked_boundaries(const BoundaryArrays<S>& arrays, const Splats<S>& s) {
  const auto& [rows, ids, samples, radius] = arrays;
  if (kOnGpu) throw nb::value_error("boundary weights run on the CPU only");
  if (s.num_views != 1 || !(radius > 0 && radius <= 1e3))
    throw nb::value_error("boundary weights need one view and a radius of at most 1000 px");
  const int64_t pixels = int64_t{s.width} * s.height;
  const Boundaries<S> found{checked(rows, pixels, "rows"), checked(ids, s.num_gaussians, "ids"),
                            checked(samples, 2 * s.num_gaussians, "samples"), static_cast<S>(radius)};
  for (int64_t i = 0; i < pixels; ++i)
    if (found.rows[i] < -1 || found.rows[i] >= s.num_gaussians)
      throw nb::value_error("rows name Gaussians that are not there");
  return found;
}

template <class S>
void bind_blending(nb::module_& module) {
  using Arrays = SplatArrays<S>;
  module.def(
      "rasterize_forward",
      [](const Arrays& in, Array<const S> colors, MaybeArray<const S> background, const EntryArrays& entries,
         const BlendSettings& settings, std::tuple<Array<S>, Array<S>, Array<int32_t>, MaybeArray<S>> out, int tallied,
         const std::optional<BoundaryArrays<S>>& bounds) {
        const Splats<S> s = in.with_colors(settings, colors);
        const int64_t pixels = s.num_views * s.width * s.height;
        const auto& [color, transmittance, stop, tally] = out;
        if (tallied < 0 || tallied > 4 || tally.has_value() != (tallied > 0))
          throw nb::value_error("rasterize: a tally needs its array");
        const Image<S> image{checked(color, pixels * s.channels, "color"),
                             checked(transmittance, pixels, "transmittance"),
                             checked(stop, pixels, "stop"),
                             checked(background, s.num_views * s.channels, "background"),
                             checked(tally, s.num_views * s.num_gaussians, "tally"),
                             static_cast<Tally>(tallied)};
        const Entries listed = checked_entries(entries, s);
        if (bounds) {
          const Boundaries<S> boundaries = checked_boundaries(*bounds, s);
          nb::gil_scoped_release release;
          if constexpr (!kOnGpu) rasterize_bounded_forward(s, listed, boundaries, image);
          return;
        }
        nb::gil_scoped_release release;
        rasterize_forward(s, listed, image);
      },
      nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg("bounds") = nb::none());
  module.def(
      "rasterize_backward",
      [](const Arrays& in, Array<const S> colors, MaybeArray<const S> background, const EntryArrays& entries,
         const BlendSettings& settings,
         std::tuple<Array<const S>, Array<const S>, Array<const S>, Array<const int32_t>> grads,
         std::tuple<Array<S>, Array<S>, Array<S>, Array<S>, MaybeArray<S>> out, bool absolute,
         const std::optional<BoundaryArrays<S>>& bounds, MaybeArray<S> g_samples) {
        const Splats<S> s = in.with_colors(settings, colors);
        const int64_t pixels = s.num_views * s.width * s.height, rows = s.num_views * s.num_gaussians;
        const auto& [g_color, g_transmittance, transmittance, stop] = grads;
        const auto& [means2d, factors, opacities, g_colors, probe] = out;
        const ImageGrads<S> from{checked(g_color, pixels * s.channels, "color gradient"),
                                 checked(g_transmittance, pixels, "transmittance gradient"),
                                 checked(transmittance, pixels, "transmittance"), checked(stop, pixels, "stop"),
                                 checked(background, s.num_views * s.channels, "background")};
        const SplatGrads<S> to{
            checked(means2d, 2 * rows, "means2d gradient"), checked(factors, 3 * rows, "factors gradient"),
            checked(opacities, rows, "opacities gradient"), checked(g_colors, rows * s.channels, "colors gradient"),
            checked(probe, 4 * rows, "probe gradient"),     absolute};
        const Entries listed = checked_entries(entries, s);
        if (bounds && g_samples) {
          const Boundaries<S> boundaries = checked_boundaries(*bounds, s);
          S* to_samples = checked(*g_samples, 2 * s.num_gaussians, "samples gradient");
          nb::gil_scoped_release release;
          if constexpr (!kOnGpu) rasterize_bounded_backward(s, listed, boundaries, from, to, to_samples);
          return;
        }
        nb::gil_scoped_release release;
        rasterize_backward(s, listed, from, to);
      },
      nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
      nb::arg("bounds") = nb::none(), nb::arg("g_samples") = nb::none());
}

}  // namespace

void bind_rasterizer(nb::module_& module) {
  nb::class_<ProjectSettings>(module, "ProjectSettings")
      .def("__init__", [](ProjectSettings* self, int64_t width, int64_t height, double eps2d, double near, double far,
                          double alpha_min, double radius_clip, bool antialiased, int64_t threads) {
        new (self) ProjectSettings{within(width, kMaxSide, "width"),
                                   within(height, kMaxSide, "height"),
                                   eps2d,
                                   near,
                                   far,
                                   alpha_min,
                                   radius_clip,
                                   antialiased,
                                   within(threads, kMaxThreads, "threads")};
      });
  nb::class_<BlendSettings>(module, "BlendSettings")
      .def("__init__", [](BlendSettings* self, int64_t width, int64_t height, double alpha_min, double alpha_max,
                          double transmittance_min, int64_t threads) {
        new (self) BlendSettings{within(width, kMaxSide, "width"),
                                 within(height, kMaxSide, "height"),
                                 alpha_min,
                                 alpha_max,
                                 transmittance_min,
                                 within(threads, kMaxThreads, "threads")};
      });
  for_each_scalar([&]<class S>() {
    constexpr bool single = sizeof(S) == 4;
    bind_projection<S>(module, single ? "GaussianArraysF32" : "GaussianArraysF64");
    bind_harmonics<S>(module);
    bind_binning<S>(module, single ? "SplatArraysF32" : "SplatArraysF64");
    bind_blending<S>(module);
    module.def("count_nonfinite", [](Array<const S> x, Array<int32_t> count, int threads) {
      int32_t* to = checked(count, 1, "count");
      nb::gil_scoped_release release;
      write_count_nonfinite(x.data(), static_cast<int64_t>(x.size()), to, threads);
    });
  });
  module.attr("MAX_SIDE") = kMaxSide;
  module.def(
      "available_memory", [](const std::string& root) { return available_memory(root); }, nb::arg("root") = "",
      "Bytes that this process can still take; `root` stands before /proc and /sys.");
}

}  // namespace dyngs

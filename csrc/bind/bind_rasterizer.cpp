// Python bindings of projection, harmonics, binning and rasterization. Argument unpacking only: arrays come in contiguous
// and of the right shape from dyngs/ops, which also allocates every output.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <optional>
#include <string>
#include <tuple>

#include "bind/arrays.hpp"
#include "bind/results.hpp"
#include "core/api.hpp"
#include "cpu/memory.hpp"

namespace nb = nanobind;

namespace dyngs {
namespace {

template <class T>
using MaybeArray = std::optional<Array<T>>;

template <class T>
T* data_or_null(const MaybeArray<T>& array) {
  return array ? array->data() : nullptr;
}

// Refuses arrays whose size is not `count`: the last line of defence before raw pointers.
template <class T>
void expect(const Array<T>& array, int64_t count, const char* name) {
  if (static_cast<int64_t>(array.size()) != count)
    throw nb::value_error(
        (std::string(name) + " has " + std::to_string(array.size()) + " elements, expected " + std::to_string(count))
            .c_str());
}
template <class T>
void expect(const MaybeArray<T>& array, int64_t count, const char* name) {
  if (array) expect(*array, count, name);
}

template <class A>
void expect_rank(const A& array, size_t rank, const char* name) {
  if (array.ndim() != rank)
    throw nb::value_error(
        (std::string(name) + " has " + std::to_string(array.ndim()) + " axes, expected " + std::to_string(rank))
            .c_str());
}

// A picture's side, or a number of threads.
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
    expect(means, 3 * n, "means"), expect(quats, 4 * n, "quats"), expect(scales, 3 * n, "scales");
    expect(opacities, n, "opacities"), expect(viewmats, 16 * v, "viewmats"), expect(intrinsics, 9 * v, "intrinsics");
    return {n, v, means.data(), quats.data(), scales.data(), opacities.data(), viewmats.data(), intrinsics.data()};
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
        expect(means2d, 2 * rows, "means2d"), expect(depths, rows, "depths"), expect(factors, 3 * rows, "factors");
        expect(compensations, rows, "compensations"), expect(radii, 2 * rows, "radii");
        const Projected<S> out{means2d.data(), depths.data(), factors.data(), compensations.data(), radii.data()};
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
    expect(radii, 2 * rows, "radii"), expect(g_means2d, 2 * rows, "means2d gradient");
    expect(g_depths, rows, "depths gradient"), expect(g_factors, 3 * rows, "factors gradient");
    expect(g_compensations, rows, "compensations gradient"), expect(means, 3 * n, "means gradient");
    expect(quats, 4 * n, "quats gradient"), expect(scales, 3 * n, "scales gradient");
    expect(viewmats, 16 * views.num_views, "viewmats gradient");
    expect(intrinsics, 9 * views.num_views, "intrinsics gradient");
    if (viewmats.has_value() != intrinsics.has_value())
      throw nb::value_error("project_backward: the gradients of viewmats and intrinsics go together");
    const ProjectedGrads<S> from{g_means2d.data(), g_depths.data(), g_factors.data(), g_compensations.data()};
    const GaussianGrads<S> to{means.data(), quats.data(), scales.data(), data_or_null(viewmats),
                              data_or_null(intrinsics)};
    nb::gil_scoped_release release;
    project_backward(views, settings.cast<S>(), radii.data(), from, to);
  });
}

template <class S>
Harmonics<S> harmonics_input(const Array<const S>& means, const Array<const S>& centers, const Array<const S>& sh,
                             const Array<const int32_t>& radii, int degree, int threads) {
  expect_rank(means, 2, "means"), expect_rank(centers, 2, "centers"), expect_rank(sh, 3, "sh");
  const int64_t n = means.shape(0), v = centers.shape(0);
  const int terms = static_cast<int>(sh.shape(1));
  expect(means, 3 * n, "means"), expect(centers, 3 * v, "centers"), expect(sh, n * terms * 3, "sh");
  expect(radii, 2 * v * n, "radii");
  if (degree < 0 || degree > 4 || (degree + 1) * (degree + 1) > terms)
    throw nb::value_error("harmonics: degree does not fit the stored terms");
  return {n, v, terms, degree, means.data(), centers.data(), sh.data(), radii.data(), threads};
}

template <class S>
void bind_harmonics(nb::module_& module) {
  module.def("harmonics_forward", [](Array<const S> means, Array<const S> centers, Array<const S> sh,
                                     Array<const int32_t> radii, Array<S> colors, int degree, int threads) {
    const Harmonics<S> in = harmonics_input(means, centers, sh, radii, degree, threads);
    expect(colors, 3 * in.num_views * in.num_gaussians, "colors");
    nb::gil_scoped_release release;
    harmonics_forward(in, colors.data());
  });
  module.def(
      "harmonics_backward", [](Array<const S> means, Array<const S> centers, Array<const S> sh,
                               Array<const int32_t> radii, std::tuple<Array<const S>, Array<const S>> colors_and_grads,
                               std::tuple<Array<S>, Array<S>, MaybeArray<S>> out, int degree, int threads) {
        const Harmonics<S> in = harmonics_input(means, centers, sh, radii, degree, threads);
        const auto& [colors, grads] = colors_and_grads;
        const auto& [g_means, g_sh, g_centers] = out;
        expect(colors, 3 * in.num_views * in.num_gaussians, "colors");
        expect(grads, 3 * in.num_views * in.num_gaussians, "colors gradient");
        expect(g_means, 3 * in.num_gaussians, "means gradient");
        expect(g_sh, 3 * in.num_gaussians * in.num_terms, "sh gradient");
        expect(g_centers, 3 * in.num_views, "centers gradient");
        nb::gil_scoped_release release;
        harmonics_backward(in, colors.data(), grads.data(), g_means.data(), g_sh.data(), data_or_null(g_centers));
      });
}

template <class S>
struct SplatArrays {
  Array<const S> means2d, factors, opacities;
  Array<const int32_t> radii;

  Splats<S> splats(const BlendSettings& settings) const {
    expect_rank(opacities, 2, "opacities");
    const int64_t v = opacities.shape(0), n = opacities.shape(1);
    expect(means2d, 2 * v * n, "means2d"), expect(factors, 3 * v * n, "factors"), expect(radii, 2 * v * n, "radii");
    return {n,
            v,
            settings.width,
            settings.height,
            0,
            means2d.data(),
            factors.data(),
            opacities.data(),
            nullptr,
            nullptr,
            radii.data(),
            static_cast<S>(settings.alpha_min),
            static_cast<S>(settings.alpha_max),
            static_cast<S>(settings.transmittance_min),
            settings.threads};
  }

  Splats<S> with_colors(const BlendSettings& settings, const Array<const S>& colors) const {
    Splats<S> s = splats(settings);
    expect_rank(colors, 3, "colors");
    if (colors.shape(2) > kMaxChannels) throw nb::value_error("rasterize: 1 to 40 channels");
    s.channels = static_cast<int>(colors.shape(2));
    if (s.channels < 1 || s.channels > kMaxChannels) throw nb::value_error("rasterize: 1 to 40 channels");
    expect(colors, s.num_views * s.num_gaussians * s.channels, "colors");
    s.colors = colors.data();
    return s;
  }
};

using EntryArrays = std::tuple<Array<const int64_t>, Array<const int32_t>, Array<const int32_t>, Array<const int32_t>>;

// Whether all of `count` indices are in [0, bound).
bool all_within(const int32_t* indices, int64_t count, int64_t bound) {
  uint32_t largest = 0;  // negative indices are larger than any other
  for (int64_t i = 0; i < count; ++i) largest = std::max(largest, static_cast<uint32_t>(indices[i]));
  return count == 0 || largest < static_cast<uint64_t>(bound);
}

// Whether all ranges of the lists of tiles and splats are ascending and within the list of entries.
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
  const int64_t tiles = s.num_views * ((s.width + kTile - 1) / kTile) * int64_t{(s.height + kTile - 1) / kTile};
  const int64_t splats = s.num_views * s.num_gaussians, count = static_cast<int64_t>(gaussians.size());
  expect(tile_offsets, tiles + 1, "tile_offsets"), expect(slot_ranges, 2 * splats, "slot_ranges");
  expect(slots, count, "slots");
  const Entries entries{tile_offsets.data(), slot_ranges.data(), gaussians.data(), slots.data(), count};
  if (!kReadable) return entries;
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
               expect(depths, s.num_views * s.num_gaussians, "depths");
               s.depths = depths.data();
               return binned(s, max_entries);
             });
}

template <class S>
void bind_blending(nb::module_& module) {
  using Arrays = SplatArrays<S>;
  module.def("rasterize_forward", [](const Arrays& in, Array<const S> colors, MaybeArray<const S> background,
                                     const EntryArrays& entries, const BlendSettings& settings,
                                     std::tuple<Array<S>, Array<S>, Array<int32_t>, MaybeArray<S>> out, int tallied) {
    const Splats<S> s = in.with_colors(settings, colors);
    const int64_t pixels = s.num_views * s.width * s.height;
    const auto& [color, transmittance, stop, tally] = out;
    expect(background, s.num_views * s.channels, "background"), expect(color, pixels * s.channels, "color");
    expect(transmittance, pixels, "transmittance"), expect(stop, pixels, "stop");
    expect(tally, s.num_views * s.num_gaussians, "tally");
    if (tallied < 0 || tallied > 4 || tally.has_value() != (tallied > 0))
      throw nb::value_error("rasterize: a tally needs its array");
    const Image<S> image{color.data(),        transmittance.data(),       stop.data(), data_or_null(background),
                         data_or_null(tally), static_cast<Tally>(tallied)};
    const Entries checked = checked_entries(entries, s);
    nb::gil_scoped_release release;
    rasterize_forward(s, checked, image);
  });
  module.def("rasterize_backward",
             [](const Arrays& in, Array<const S> colors, MaybeArray<const S> background, const EntryArrays& entries,
                const BlendSettings& settings,
                std::tuple<Array<const S>, Array<const S>, Array<const S>, Array<const int32_t>> grads,
                std::tuple<Array<S>, Array<S>, Array<S>, Array<S>, MaybeArray<S>> out, bool absolute) {
               const Splats<S> s = in.with_colors(settings, colors);
               const int64_t pixels = s.num_views * s.width * s.height, rows = s.num_views * s.num_gaussians;
               const auto& [g_color, g_transmittance, transmittance, stop] = grads;
               const auto& [means2d, factors, opacities, g_colors, probe] = out;
               expect(background, s.num_views * s.channels, "background");
               expect(g_color, pixels * s.channels, "color gradient");
               expect(g_transmittance, pixels, "transmittance gradient"), expect(stop, pixels, "stop");
               expect(transmittance, pixels, "transmittance"), expect(means2d, 2 * rows, "means2d gradient");
               expect(factors, 3 * rows, "factors gradient"), expect(opacities, rows, "opacities gradient");
               expect(g_colors, rows * s.channels, "colors gradient"), expect(probe, 4 * rows, "probe gradient");
               const ImageGrads<S> from{g_color.data(), g_transmittance.data(), transmittance.data(), stop.data(),
                                        data_or_null(background)};
               const SplatGrads<S> to{means2d.data(),  factors.data(),      opacities.data(),
                                      g_colors.data(), data_or_null(probe), absolute};
               const Entries checked = checked_entries(entries, s);
               nb::gil_scoped_release release;
               rasterize_backward(s, checked, from, to);
             });
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
  bind_projection<float>(module, "GaussianArraysF32"), bind_projection<double>(module, "GaussianArraysF64");
  bind_harmonics<float>(module), bind_harmonics<double>(module);
  bind_binning<float>(module, "SplatArraysF32"), bind_binning<double>(module, "SplatArraysF64");
  bind_blending<float>(module), bind_blending<double>(module);
  module.attr("MAX_SIDE") = kMaxSide;
  module.def(
      "available_memory", [](const std::string& root) { return available_memory(root); }, nb::arg("root") = "",
      "Bytes that this process can still take; `root` stands before /proc and /sys.");
  module.def("count_nonfinite", [](Array<const float> x, Array<int32_t> count, int threads) {
    expect(count, 1, "count");
    nb::gil_scoped_release release;
    write_count_nonfinite(x.data(), static_cast<int64_t>(x.size()), count.data(), threads);
  });
  module.def("count_nonfinite", [](Array<const double> x, Array<int32_t> count, int threads) {
    expect(count, 1, "count");
    nb::gil_scoped_release release;
    write_count_nonfinite(x.data(), static_cast<int64_t>(x.size()), count.data(), threads);
  });
}

}  // namespace dyngs

// Python bindings of Bezier patches. Argument unpacking only, and indices checked. For the CPU alone.
#if !defined(DYNGS_GPU)
#include "bind/arrays.hpp"
#include "core/triangles.hpp"

namespace dyngs {
namespace {

// Checks that all indices are in [lowest, end).
void require_indices(const int32_t* indices, int64_t count, int64_t lowest, int64_t end, const char* message) {
  for (int64_t i = 0; i < count; ++i) {
    if (indices[i] < lowest || indices[i] >= end) throw nb::value_error(message);
  }
}

template <class T>
using Values = Array<T, nb::ndim<3>>;

template <class V>
PatchPlaces patch_places(const Array<const int32_t>& ids, const V& values, int basis, int threads) {
  if (basis < -2 || basis > 64) throw nb::value_error("patches: no such basis");
  PatchPlaces places{};
  places.ids = ids.data(), places.count = ids.size();
  places.patches = values.shape(0), places.values = values.shape(1), places.channels = values.shape(2);
  places.basis = basis > 0 ? PatchBasis::kLattice : static_cast<PatchBasis>(basis);
  places.segments = basis, places.threads = threads;
  if (places.values != (basis > 0 ? lattice_size(basis) : kPatchPoints))
    throw nb::value_error("patches: values that are not those of the basis");
  require_indices(places.ids, places.count, 0, places.patches, "patches: an index that no patch has");
  return places;
}

template <class S>
void values_forward(Rows<const S> uv, Array<const int32_t> ids, Values<const S> values, int basis, Rows<S> out,
                    int threads) {
  const PatchPlaces places = patch_places(ids, values, basis, threads);
  const S* at = checked(uv, places.count, 2, "patches: places");
  S* to = checked(out, places.count, places.channels, "patches: results");
  nb::gil_scoped_release release;
  patch_values_forward(places, at, values.data(), to);
}

template <class S>
void values_backward(Rows<const S> uv, Array<const int32_t> ids, Rows<const S> g_out, int basis, Values<S> g_values,
                     int threads) {
  const PatchPlaces places = patch_places(ids, g_values, basis, threads);
  const S* at = checked(uv, places.count, 2, "patches: places");
  const S* from = checked(g_out, places.count, places.channels, "patches: gradient");
  nb::gil_scoped_release release;
  patch_values_backward(places, at, from, g_values.data());
}

template <class S>
void visible(Array<const S> points, Array<const S> viewmats, Array<const S> intrinsics, int segments, double near,
             Values<int32_t> ids, Array<S> uv, int threads) {
  if (segments < 1 || segments > 64 || !(near > 0)) throw nb::value_error("patches: segments or near");
  PatchViews<S> in{};
  in.patches = static_cast<int64_t>(points.size()) / (3 * kPatchPoints), in.views = ids.shape(0);
  in.height = static_cast<int>(ids.shape(1)), in.width = static_cast<int>(ids.shape(2));
  if (in.height > 1 << 15 || in.width > 1 << 15) throw nb::value_error("patches: an image that is too large");
  in.points = checked(points, 3 * kPatchPoints * in.patches, "patches: points");
  in.viewmats = checked(viewmats, 16 * in.views, "patches: cameras");
  in.intrinsics = checked(intrinsics, 9 * in.views, "patches: cameras");
  in.segments = segments, in.near = static_cast<S>(near), in.threads = threads;
  const VisiblePatches<S> out{ids.data(), checked(uv, 2 * static_cast<int64_t>(ids.size()), "patches: places")};
  nb::gil_scoped_release release;
  visible_patches(in, out);
}

// Standard deviation and radius, px.
using BlendSizes = std::tuple<double, double>;

template <class S>
PatchImage<S> patch_image(const Rows<const S>& means, const Rows<const S>& colours, const Values<const int32_t>& rows,
                          const Array<const int32_t>& ids, const BlendSizes& sizes, int threads) {
  const auto [sigma, radius] = sizes;
  if (!(sigma > 0) || !(radius > 0) || radius > 8) throw nb::value_error("patches: sigma or radius");
  PatchImage<S> in{};
  in.count = ids.size(), in.views = rows.shape(0);
  in.height = static_cast<int>(rows.shape(1)), in.width = static_cast<int>(rows.shape(2));
  in.channels = static_cast<int>(colours.shape(1));
  if (in.channels > kMostPatchChannels) throw nb::value_error("patches: too many channels");
  in.rows = rows.data(), in.ids = ids.data();
  in.means = checked(means, in.count, 2, "patches: means");
  in.colours = checked(colours, in.count, in.channels, "patches: colours");
  in.sigma = static_cast<S>(sigma), in.radius = static_cast<S>(radius), in.threads = threads;
  require_indices(in.rows, rows.size(), -1, in.count, "patches: a row that is not there");
  return in;
}

template <class S>
void blend_forward(Rows<const S> means, Rows<const S> colours, Values<const int32_t> rows, Array<const int32_t> ids,
                   const BlendSizes& sizes, const std::tuple<Array<S>, Array<S>, Array<S>>& out, int threads) {
  const PatchImage<S> in = patch_image<S>(means, colours, rows, ids, sizes, threads);
  const auto& [image, transmittance, sums] = out;
  const auto pixels = static_cast<int64_t>(rows.size());
  const BlendedPatches<S> to{checked(image, pixels * in.channels, "patches: image"),
                             checked(transmittance, pixels, "patches: image"), checked(sums, pixels, "patches: image")};
  nb::gil_scoped_release release;
  blend_patches_forward(in, to);
}

template <class S>
void blend_backward(Rows<const S> means, Rows<const S> colours, Values<const int32_t> rows, Array<const int32_t> ids,
                    const BlendSizes& sizes, const std::tuple<Array<const S>, Array<const S>, Array<const S>>& out,
                    const std::tuple<Array<const S>, Array<const S>>& grads, Rows<S> g_means, Rows<S> g_colours,
                    int threads) {
  const PatchImage<S> in = patch_image<S>(means, colours, rows, ids, sizes, threads);
  const auto& [image, transmittance, sums] = out;
  const auto pixels = static_cast<int64_t>(rows.size());
  const BlendedPatches<const S> from{checked(image, pixels * in.channels, "patches: image"),
                                     checked(transmittance, pixels, "patches: image"),
                                     checked(sums, pixels, "patches: image")};
  const S* g_image = checked(std::get<0>(grads), pixels * in.channels, "patches: gradient");
  const S* g_transmittance = checked(std::get<1>(grads), pixels, "patches: gradient");
  S* by_means = checked(g_means, in.count, 2, "patches: gradient");
  S* by_colours = checked(g_colours, in.count, in.channels, "patches: gradient");
  nb::gil_scoped_release release;
  blend_patches_backward(in, from, g_image, g_transmittance, by_means, by_colours);
}

template <class S>
void bind_scalar(nb::module_& module) {
  module.def("patch_values_forward", values_forward<S>, array("uv"), array("ids"), array("values"), nb::arg("basis"),
             array("out"), nb::arg("threads"));
  module.def("patch_values_backward", values_backward<S>, array("uv"), array("ids"), array("g_out"), nb::arg("basis"),
             array("g_values"), nb::arg("threads"));
  module.def("visible_patches", visible<S>, array("points"), array("viewmats"), array("intrinsics"),
             nb::arg("segments"), nb::arg("near"), array("ids"), array("uv"), nb::arg("threads"));
  module.def("blend_patches_forward", blend_forward<S>, array("means"), array("colours"), array("rows"), array("ids"),
             nb::arg("sizes"), array("out"), nb::arg("threads"));
  module.def("blend_patches_backward", blend_backward<S>, array("means"), array("colours"), array("rows"), array("ids"),
             nb::arg("sizes"), array("out"), array("grads"), array("g_means"), array("g_colours"), nb::arg("threads"));
}

}  // namespace

void bind_triangles(nb::module_& module) {
  for_each_scalar([&]<class S>() { bind_scalar<S>(module); });
}

}  // namespace dyngs
#endif

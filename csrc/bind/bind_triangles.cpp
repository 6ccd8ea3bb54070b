// Python bindings of Bezier patches. Argument unpacking only, and indices checked where they can be read.
#include "bind/arrays.hpp"
#include "core/triangles.hpp"

namespace dyngs {
namespace {

// Checks that all indices are in [lowest, end).
void require_indices(const int32_t* indices, int64_t count, int64_t lowest, int64_t end, const char* message) {
  for (int64_t i = 0; !kOnGpu && i < count; ++i) {
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

using Indices = Array<const int32_t>;

template <class S>
void ends(Array<const S> points, Array<const S> viewmats, Array<const S> intrinsics, Rows<const S> uv,
          const std::tuple<Indices, Indices, Indices>& from, Array<bool> found,
          const std::tuple<Array<S>, Rows<S>, Rows<S>>& out, int threads) {
  const auto& [views, ids, directions] = from;
  const int64_t count = uv.shape(0), patches = static_cast<int64_t>(points.size()) / (3 * kPatchPoints);
  const int64_t cameras = static_cast<int64_t>(viewmats.size()) / 16;
  PatchSteps<S> in{};
  in.points = checked(points, 3 * kPatchPoints * patches, "patches: points");
  in.viewmats = checked(viewmats, 16 * cameras, "patches: cameras");
  in.intrinsics = checked(intrinsics, 9 * cameras, "patches: cameras");
  in.views = checked(views, count, "patches: views"), in.ids = checked(ids, count, "patches: ids");
  in.directions = checked(directions, count, "patches: directions");
  in.uv = checked(uv, count, 2, "patches: places"), in.count = count, in.threads = threads;
  require_indices(in.views, count, 0, cameras, "patches: a view that is not there");
  require_indices(in.ids, count, -1, patches, "patches: an index that no patch has");
  require_indices(in.directions, count, 0, kDirections, "patches: no such direction");
  const auto& [steps, places, slopes] = out;
  const PatchEnds<S> to{checked(found, count, "patches: ends"), checked(steps, count, "patches: ends"),
                        checked(places, count, 2, "patches: ends"), checked(slopes, count, 2, "patches: ends")};
  nb::gil_scoped_release release;
  patch_ends(in, to);
}

template <class S>
PatchImage<S> patch_image(const Rows<const S>& colours, const Array<const S>& crossings,
                          const Values<const int32_t>& rows, const Indices& ids, int threads) {
  PatchImage<S> in{};
  in.count = ids.size(), in.views = rows.shape(0);
  in.height = static_cast<int>(rows.shape(1)), in.width = static_cast<int>(rows.shape(2));
  in.channels = static_cast<int>(colours.shape(1));
  in.rows = rows.data(), in.ids = ids.data();
  in.colours = checked(colours, in.count, in.channels, "patches: colours");
  in.crossings = checked(crossings, 2 * static_cast<int64_t>(rows.size()), "patches: crossings");
  in.threads = threads;
  require_indices(in.rows, rows.size(), -1, in.count, "patches: a row that is not there");
  return in;
}

template <class S>
void blend_forward(Rows<const S> colours, Array<const S> crossings, Values<const int32_t> rows, Indices ids,
                   const std::tuple<Array<S>, Array<S>>& out, int threads) {
  const PatchImage<S> in = patch_image<S>(colours, crossings, rows, ids, threads);
  const auto& [image, transmittance] = out;
  const auto pixels = static_cast<int64_t>(rows.size());
  const BlendedPatches<S> to{checked(image, pixels * in.channels, "patches: image"),
                             checked(transmittance, pixels, "patches: image")};
  nb::gil_scoped_release release;
  blend_patches_forward(in, to);
}

template <class S>
void blend_backward(Rows<const S> colours, Array<const S> crossings, Values<const int32_t> rows, Indices ids,
                    const std::tuple<Array<const S>, Array<const S>>& grads,
                    const std::tuple<Rows<S>, Rows<S>, Array<S>>& out, int threads) {
  const PatchImage<S> in = patch_image<S>(colours, crossings, rows, ids, threads);
  const auto pixels = static_cast<int64_t>(rows.size());
  const BlendedPatches<const S> from{checked(std::get<0>(grads), pixels * in.channels, "patches: gradient"),
                                     checked(std::get<1>(grads), pixels, "patches: gradient")};
  const auto& [means, by_colours, by_crossings] = out;
  const PatchGrads<S> to{checked(means, in.count, 2, "patches: gradient"),
                         checked(by_colours, in.count, in.channels, "patches: gradient"),
                         checked(by_crossings, 2 * pixels, "patches: gradient")};
  nb::gil_scoped_release release;
  blend_patches_backward(in, from, to);
}

template <class S>
void bind_scalar(nb::module_& module) {
  module.def("patch_values_forward", values_forward<S>, array("uv"), array("ids"), array("values"), nb::arg("basis"),
             array("out"), nb::arg("threads"));
  module.def("patch_values_backward", values_backward<S>, array("uv"), array("ids"), array("g_out"), nb::arg("basis"),
             array("g_values"), nb::arg("threads"));
  module.def("visible_patches", visible<S>, array("points"), array("viewmats"), array("intrinsics"),
             nb::arg("segments"), nb::arg("near"), array("ids"), array("uv"), nb::arg("threads"));
  module.def("patch_ends", ends<S>, array("points"), array("viewmats"), array("intrinsics"), array("uv"), array("from"),
             array("found"), array("out"), nb::arg("threads"));
  module.def("blend_patches_forward", blend_forward<S>, array("colours"), array("crossings"), array("rows"),
             array("ids"), array("out"), nb::arg("threads"));
  module.def("blend_patches_backward", blend_backward<S>, array("colours"), array("crossings"), array("rows"),
             array("ids"), array("grads"), array("out"), nb::arg("threads"));
}

}  // namespace

void bind_triangles(nb::module_& module) {
  for_each_scalar([&]<class S>() { bind_scalar<S>(module); });
}

}  // namespace dyngs

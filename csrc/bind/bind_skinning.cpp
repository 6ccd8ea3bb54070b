// Python bindings of linear blend skinning. Argument unpacking only.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <optional>
#include <tuple>

#include "bind/arrays.hpp"
#include "core/api.hpp"

namespace nb = nanobind;

namespace dyngs {
namespace {

template <class S>
using Rows = Array<S, nb::ndim<2>>;
template <class S>
using NodeArrays = std::tuple<Rows<const S>, Array<const S, nb::ndim<1>>, Rows<const S>, Rows<const S>>;
template <class S>
using PointArrays = std::tuple<Rows<const S>, Rows<const int64_t>>;

template <class T>
void require_shape(const Rows<T>& rows, size_t count, size_t width) {
  if (rows.shape(0) != count || rows.shape(1) != width) throw nb::value_error("skinning: arrays of different sizes");
}

template <class S>
SkinNodes<S> nodes_input(const NodeArrays<S>& arrays) {
  const auto& [positions, radii, motion, values] = arrays;
  const size_t count = radii.shape(0), width = values.shape(1);
  require_shape(positions, count, 3), require_shape(motion, count, 7), require_shape(values, count, width);
  return {positions.data(),           radii.data(), motion.data(), values.data(), static_cast<int64_t>(count),
          static_cast<int64_t>(width)};
}

template <class S>
SkinPoints<S> points_input(const PointArrays<S>& arrays, int64_t num_nodes) {
  const auto& [coords, followed] = arrays;
  require_shape(coords, followed.shape(0), 3);
  if (kReadable && !follow_within(followed.data(), static_cast<int64_t>(followed.size()), num_nodes))
    throw nb::index_error("skinning: a point follows a node that does not exist");
  return {coords.data(), followed.data(), static_cast<int64_t>(followed.shape(0)),
          static_cast<int64_t>(followed.shape(1))};
}

// The arrays per point of both passes.
template <class T>
Skinned<T> skinned_arrays(const Rows<T>& offset, const Rows<T>& blended, const Rows<T>& weights, size_t count,
                          size_t width, size_t per_point) {
  require_shape(offset, count, 3), require_shape(blended, count, width), require_shape(weights, count, per_point);
  return {offset.data(), blended.data(), weights.data()};
}

template <class S>
void skinning_forward_arrays(const NodeArrays<S>& node_arrays, const PointArrays<S>& point_arrays,
                             const Rows<S>& offset, const Rows<S>& blended, const Rows<S>& weights, int threads) {
  const SkinNodes<S> nodes = nodes_input<S>(node_arrays);
  const SkinPoints<S> points = points_input<S>(point_arrays, nodes.count);
  const Skinned<S> out = skinned_arrays<S>(offset, blended, weights, points.count, nodes.width, points.nodes);
  nb::gil_scoped_release release;
  skinning_forward(nodes, points, out, threads);
}

template <class S>
void skinning_backward_arrays(const NodeArrays<S>& node_arrays, const PointArrays<S>& point_arrays,
                              const std::tuple<Rows<const S>, Rows<const S>, Rows<const S>>& g_arrays,
                              const std::optional<Rows<S>>& g_points, const Rows<S>& g_motion, const Rows<S>& g_values,
                              int threads) {
  const SkinNodes<S> nodes = nodes_input<S>(node_arrays);
  const SkinPoints<S> points = points_input<S>(point_arrays, nodes.count);
  const auto& [g_offset, g_blended, weights] = g_arrays;
  const Skinned<const S> g =
      skinned_arrays<const S>(g_offset, g_blended, weights, points.count, nodes.width, points.nodes);
  if (g_points) require_shape(*g_points, points.count, 3);
  require_shape(g_motion, nodes.count, 7), require_shape(g_values, nodes.count, nodes.width);
  nb::gil_scoped_release release;
  skinning_backward(nodes, points, g,
                    SkinGrads<S>{g_points ? g_points->data() : nullptr, g_motion.data(), g_values.data()}, threads);
}

template <class S>
void bind_skinning_of(nb::module_& module) {
  module.def("skinning_forward", skinning_forward_arrays<S>, nb::arg("nodes").noconvert(),
             nb::arg("points").noconvert(), nb::arg("offset").noconvert(), nb::arg("blended").noconvert(),
             nb::arg("weights").noconvert(), nb::arg("num_threads"),
             "Writes (M, 3) offsets, (M, D) blended values and (M, B) weights. Nodes: positions (S, 3), radii (S,), "
             "motion (S, 7), values (S, D). Points: coordinates (M, 3), followed (M, B).");
  module.def("skinning_backward", skinning_backward_arrays<S>, nb::arg("nodes").noconvert(),
             nb::arg("points").noconvert(), nb::arg("g").noconvert(), nb::arg("g_points").noconvert().none(),
             nb::arg("g_motion").noconvert(), nb::arg("g_values").noconvert(), nb::arg("num_threads"),
             "Writes gradients from g: those by offset and blended, and the weights of the forward pass.");
}

}  // namespace

void bind_skinning(nb::module_& module) { bind_skinning_of<float>(module), bind_skinning_of<double>(module); }

}  // namespace dyngs

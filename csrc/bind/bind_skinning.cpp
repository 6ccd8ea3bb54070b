// Python bindings of linear blend skinning. Argument unpacking only.
#include "bind/arrays.hpp"
#include "core/api.hpp"

namespace dyngs {
namespace {

constexpr const char* kOp = "skinning";

template <class S>
using NodeArrays = std::tuple<Rows<const S>, Array<const S, nb::ndim<1>>, Rows<const S>, Rows<const S>>;
template <class S>
using PointArrays = std::tuple<Rows<const S>, Rows<const int64_t>>;

template <class S>
SkinNodes<S> nodes_input(const NodeArrays<S>& arrays) {
  const auto& [positions, radii, motion, values] = arrays;
  const int64_t count = radii.shape(0), width = values.shape(1);
  return {checked(positions, count, 3, kOp),  radii.data(), checked(motion, count, 7, kOp),
          checked(values, count, width, kOp), count,        width};
}

template <class S>
SkinPoints<S> points_input(const PointArrays<S>& arrays, int64_t num_nodes) {
  const auto& [coords, followed] = arrays;
  const int64_t count = followed.shape(0), per_point = followed.shape(1);
  if (!kOnGpu && !follow_within(followed.data(), count * per_point, num_nodes))
    throw nb::index_error("skinning: a point follows a node that does not exist");
  return {checked(coords, count, 3, kOp), followed.data(), count, per_point};
}

// The arrays per point of both passes.
template <class T, class S>
Skinned<T> skinned_arrays(const Rows<T>& offset, const Rows<T>& blended, const Rows<T>& weights,
                          const SkinPoints<S>& points, int64_t width) {
  return {checked(offset, points.count, 3, kOp), checked(blended, points.count, width, kOp),
          checked(weights, points.count, points.nodes, kOp)};
}

template <class S>
void skinning_forward_arrays(const NodeArrays<S>& node_arrays, const PointArrays<S>& point_arrays,
                             const Rows<S>& offset, const Rows<S>& blended, const Rows<S>& weights, int threads) {
  const SkinNodes<S> nodes = nodes_input<S>(node_arrays);
  const SkinPoints<S> points = points_input<S>(point_arrays, nodes.count);
  const Skinned<S> out = skinned_arrays<S>(offset, blended, weights, points, nodes.width);
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
  const Skinned<const S> g = skinned_arrays<const S>(g_offset, g_blended, weights, points, nodes.width);
  const SkinGrads<S> out{checked(g_points, points.count, 3, kOp), checked(g_motion, nodes.count, 7, kOp),
                         checked(g_values, nodes.count, nodes.width, kOp)};
  nb::gil_scoped_release release;
  skinning_backward(nodes, points, g, out, threads);
}

template <class S>
void bind_skinning_of(nb::module_& module) {
  module.def("skinning_forward", skinning_forward_arrays<S>, array("nodes"), array("points"), array("offset"),
             array("blended"), array("weights"), nb::arg("num_threads"),
             "Writes (M, 3) offsets, (M, D) blended values and (M, B) weights. Nodes: positions (S, 3), radii (S,), "
             "motion (S, 7), values (S, D). Points: coordinates (M, 3), followed (M, B).");
  module.def("skinning_backward", skinning_backward_arrays<S>, array("nodes"), array("points"), array("g"),
             array("g_points").none(), array("g_motion"), array("g_values"), nb::arg("num_threads"),
             "Writes gradients from g: those by offset and blended, and the weights of the forward pass.");
}

}  // namespace

void bind_skinning(nb::module_& module) {
  for_each_scalar([&]<class S>() { bind_skinning_of<S>(module); });
}

}  // namespace dyngs

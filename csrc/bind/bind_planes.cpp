// Python bindings of the HexPlane look-up and of the penalties of its planes. Argument unpacking only.
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <vector>

#include "bind/arrays.hpp"
#include "bind/results.hpp"
#include "core/api.hpp"

namespace dyngs {
namespace {

template <class S>
using Planes = Array<S, nb::shape<3, -1, -1, -1>>;
template <class S>
using Levels = std::vector<std::tuple<Planes<S>, Planes<S>>>;  // space, time

template <class S>
bool same_shape(const Planes<const S>& a, const Planes<S>& b) {
  return a.shape(1) == b.shape(1) && a.shape(2) == b.shape(2) && a.shape(3) == b.shape(3);
}

template <class S>
std::vector<PlaneLevel<S>> levels_input(const Levels<const S>& levels) {
  if (levels.empty()) throw nb::value_error("hexplane: no levels");
  const size_t channels = std::get<0>(levels[0]).shape(3);
  std::vector<PlaneLevel<S>> out;
  for (const auto& [space, over_time] : levels) {
    const size_t size = space.shape(1);
    if (size == 0 || over_time.shape(1) == 0 || space.shape(2) != size || over_time.shape(2) != size ||
        space.shape(3) != channels || over_time.shape(3) != channels)
      throw nb::value_error("hexplane: planes of sizes that do not fit each other");
    out.push_back(
        {space.data(), over_time.data(), static_cast<int64_t>(size), static_cast<int64_t>(over_time.shape(1))});
  }
  return out;
}

template <class S>
HexPlane<S> hexplane_input(const Levels<const S>& levels, const std::vector<PlaneLevel<S>>& inputs, double time) {
  return {inputs, static_cast<int64_t>(std::get<0>(levels[0]).shape(3)), time};
}

template <class S>
std::vector<PlaneGrads<S>> grads_output(const Levels<const S>& levels, const Levels<S>& grads) {
  if (grads.size() != levels.size()) throw nb::value_error("hexplane: gradients of another number of levels");
  std::vector<PlaneGrads<S>> out;
  for (size_t l = 0; l < levels.size(); ++l) {
    const auto& [space, time] = grads[l];
    if (!same_shape<S>(std::get<0>(levels[l]), space) || !same_shape<S>(std::get<1>(levels[l]), time))
      throw nb::value_error("hexplane: gradients of another size than the planes");
    out.push_back({space.data(), time.data()});
  }
  return out;
}

template <class S>
void hexplane_forward_arrays(const Array<const S, nb::shape<-1, 3>>& coords, const Levels<const S>& levels, double time,
                             const Array<S, nb::ndim<2>>& features, const Array<int32_t, nb::ndim<1>>& order,
                             int threads) {
  const auto inputs = levels_input<S>(levels);
  const HexPlane<S> planes = hexplane_input<S>(levels, inputs, time);
  const PlanePoints<S> points{coords.data(), static_cast<int64_t>(coords.shape(0))};
  if (features.shape(0) != coords.shape(0) || order.shape(0) != coords.shape(0) ||
      features.shape(1) != levels.size() * planes.channels)
    throw nb::value_error("hexplane_forward: arrays of different sizes");
  nb::gil_scoped_release release;
  hexplane_forward(planes, points, features.data(), order.data(), threads);
}

template <class S>
void hexplane_backward_arrays(const Array<const S, nb::shape<-1, 3>>& coords, const Levels<const S>& levels,
                              double time, const Array<const int32_t, nb::ndim<1>>& order,
                              const Array<const S, nb::ndim<2>>& g_features, const Levels<S>& g_levels,
                              const std::optional<Array<S, nb::shape<-1, 3>>>& g_coords, int threads) {
  const auto inputs = levels_input<S>(levels);
  const HexPlane<S> planes = hexplane_input<S>(levels, inputs, time);
  const auto grads = grads_output<S>(levels, g_levels);
  const PlanePoints<S> points{coords.data(), static_cast<int64_t>(coords.shape(0))};
  if (g_features.shape(0) != coords.shape(0) || order.shape(0) != coords.shape(0) ||
      (g_coords && g_coords->shape(0) != coords.shape(0)) || g_features.shape(1) != levels.size() * planes.channels)
    throw nb::value_error("hexplane_backward: arrays of different sizes");
  const auto missing = [&points](int32_t i) { return i < 0 || i >= points.count; };
  if (!kOnGpu && std::any_of(order.data(), order.data() + points.count, missing))
    throw nb::index_error("hexplane_backward: no such point");
  nb::gil_scoped_release release;
  hexplane_backward<S>(planes, points, order.data(), g_features.data(), grads, g_coords ? g_coords->data() : nullptr,
                       threads);
}

template <class S>
void plane_penalty_arrays(const Levels<const S>& levels, const std::optional<Levels<S>>& g_levels,
                          const std::tuple<double, double, double>& weights, const Array<double, nb::shape<1>>& penalty,
                          int threads) {
  const auto inputs = levels_input<S>(levels);
  const HexPlane<S> planes = hexplane_input<S>(levels, inputs, 0.0);
  const auto grads = g_levels ? grads_output<S>(levels, *g_levels) : std::vector<PlaneGrads<S>>{};
  const auto [space, time, one] = weights;
  nb::gil_scoped_release release;
  write_plane_penalty<S>(planes, PenaltyWeights{space, time, one}, grads, penalty.data(), threads);
}

template <class S>
void bind_planes_of(nb::module_& module) {
  module.def("hexplane_forward", hexplane_forward_arrays<S>, array("coords"), array("levels"), nb::arg("time"),
             array("features"), array("order"), nb::arg("num_threads"),
             "Writes (M, L * C) features of (M, 3) coordinates, and the order of visit for the backward pass.");
  module.def("hexplane_backward", hexplane_backward_arrays<S>, array("coords"), array("levels"), nb::arg("time"),
             array("order"), array("g_features"), array("g_levels"), array("g_coords").none(), nb::arg("num_threads"),
             "Writes the gradients by the planes and, unless None, by the coordinates.");
  module.def("plane_penalty", plane_penalty_arrays<S>, array("levels"), array("g_levels").none(), nb::arg("weights"),
             array("penalty"), nb::arg("num_threads"),
             "Writes the weighted sum of the penalties of all planes, and its gradient unless that is None.");
}

}  // namespace

void bind_planes(nb::module_& module) {
  for_each_scalar([&]<class S>() { bind_planes_of<S>(module); });
}

}  // namespace dyngs

// Python bindings of skinning by joints. Argument unpacking only.
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
using Matrices = Array<S, nb::shape<-1, 3, 4>>;
// Means, quaternions, log scales; of gradients likewise.
template <class S>
using Shapes = std::tuple<Rows<S>, Rows<S>, Rows<S>>;

template <class T>
void require_shape(const T& rows, size_t count, size_t width) {
  if (rows.shape(0) != count || rows.shape(1) != width) throw nb::value_error("posing: arrays of different sizes");
}

template <class S>
void require_shapes(const Shapes<S>& arrays, int64_t count) {
  const auto& [means, quats, log_scales] = arrays;
  require_shape(means, count, 3), require_shape(quats, count, 4), require_shape(log_scales, count, 3);
}

template <class S>
Posing<S> posing_input(const Shapes<const S>& rest, const Rows<const S>& weights, const Matrices<const S>& transforms) {
  const size_t count = weights.shape(0), joints = transforms.shape(0);
  require_shapes(rest, count), require_shape(weights, count, joints);
  const auto& [means, quats, log_scales] = rest;
  return {static_cast<int64_t>(count),
          static_cast<int64_t>(joints),
          means.data(),
          quats.data(),
          log_scales.data(),
          weights.data(),
          transforms.data()};
}

template <class T, class S>
Posed<T> posed_arrays(const Shapes<T>& arrays, const Matrices<T>& blended, const Rows<T>& kept, const Posing<S>& in) {
  require_shapes(arrays, in.count), require_shape(kept, in.count, 12), require_shape(blended, in.count, 3);
  const auto& [means, quats, log_scales] = arrays;
  return {means.data(), quats.data(), log_scales.data(), blended.data(), kept.data()};
}

template <class S>
void pose_forward_arrays(const Shapes<const S>& rest, const Rows<const S>& weights, const Matrices<const S>& transforms,
                         const Shapes<S>& moved, const Matrices<S>& blended, const Rows<S>& kept, int threads) {
  const Posing<S> in = posing_input<S>(rest, weights, transforms);
  const Posed<S> out = posed_arrays<S>(moved, blended, kept, in);
  nb::gil_scoped_release release;
  pose_forward(in, out, threads);
}

template <class S>
using PosedArrays = std::tuple<Shapes<const S>, Matrices<const S>, Rows<const S>>;

template <class S>
void pose_backward_arrays(const Shapes<const S>& rest, const Rows<const S>& weights,
                          const Matrices<const S>& transforms, const PosedArrays<S>& posed, const Shapes<const S>& g,
                          const std::optional<Matrices<const S>>& g_blended, const Shapes<S>& g_rest,
                          const std::optional<Rows<S>>& g_weights, const Matrices<S>& g_transforms, int threads) {
  const Posing<S> in = posing_input<S>(rest, weights, transforms);
  const auto& [moved, blended, kept] = posed;
  const Posed<const S> forward = posed_arrays<const S>(moved, blended, kept, in);
  require_shapes(g, in.count), require_shapes(g_rest, in.count), require_shape(g_transforms, in.joints, 3);
  if (g_blended) require_shape(*g_blended, in.count, 3);
  if (g_weights) require_shape(*g_weights, in.count, in.joints);
  const auto& [by_means, by_quats, by_log_scales] = g;
  const auto& [g_means, g_quats, g_log_scales] = g_rest;
  const PosedGrads<S> grads{by_means.data(), by_quats.data(), by_log_scales.data(),
                            g_blended ? g_blended->data() : nullptr};
  const PosingGrads<S> out{g_means.data(), g_quats.data(), g_log_scales.data(), g_weights ? g_weights->data() : nullptr,
                           g_transforms.data()};
  nb::gil_scoped_release release;
  pose_backward(in, forward, grads, out, threads);
}

template <class S>
void bind_posing_of(nb::module_& module) {
  module.def(
      "pose_forward", pose_forward_arrays<S>, nb::arg("rest").noconvert(), nb::arg("weights").noconvert(),
      nb::arg("transforms").noconvert(), nb::arg("moved").noconvert(), nb::arg("blended").noconvert(),
      nb::arg("kept").noconvert(), nb::arg("num_threads"),
      "Writes moved means (N, 3), quaternions (N, 4) and log scales (N, 3), blended transforms (N, 3, 4) and what "
      "the backward pass needs (N, 12), from the same at rest, weights (N, J) and transforms (J, 3, 4).");
  module.def("pose_backward", pose_backward_arrays<S>, nb::arg("rest").noconvert(), nb::arg("weights").noconvert(),
             nb::arg("transforms").noconvert(), nb::arg("posed").noconvert(), nb::arg("g").noconvert(),
             nb::arg("g_blended").noconvert().none(), nb::arg("g_rest").noconvert(),
             nb::arg("g_weights").noconvert().none(), nb::arg("g_transforms").noconvert(), nb::arg("num_threads"),
             "Writes gradients by all inputs, by the weights only if asked for.");
}

}  // namespace

void bind_posing(nb::module_& module) { bind_posing_of<float>(module), bind_posing_of<double>(module); }

}  // namespace dyngs

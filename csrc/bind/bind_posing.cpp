// Python bindings of skinning by joints. Argument unpacking only.
#include "bind/arrays.hpp"
#include "core/api.hpp"

namespace dyngs {
namespace {

constexpr const char* kOp = "posing";

template <class S>
using Matrices = Array<S, nb::shape<-1, 3, 4>>;
// Means, quaternions, log scales; of gradients likewise.
template <class S>
using Shapes = std::tuple<Rows<S>, Rows<S>, Rows<S>>;

template <class S>
Posing<S> posing_input(const Shapes<const S>& rest, const Rows<const S>& weights, const Matrices<const S>& transforms) {
  const int64_t count = weights.shape(0), joints = transforms.shape(0);
  const auto& [means, quats, log_scales] = rest;
  return {count,
          joints,
          checked(means, count, 3, kOp),
          checked(quats, count, 4, kOp),
          checked(log_scales, count, 3, kOp),
          checked(weights, count, joints, kOp),
          transforms.data()};
}

template <class T>
Posed<T> posed_arrays(const Shapes<T>& arrays, const Matrices<T>& blended, const Rows<T>& kept, int64_t count) {
  const auto& [means, quats, log_scales] = arrays;
  return {checked(means, count, 3, kOp), checked(quats, count, 4, kOp), checked(log_scales, count, 3, kOp),
          checked(blended, count, 3, kOp), checked(kept, count, 12, kOp)};
}

template <class S>
void pose_forward_arrays(const Shapes<const S>& rest, const Rows<const S>& weights, const Matrices<const S>& transforms,
                         const Shapes<S>& moved, const Matrices<S>& blended, const Rows<S>& kept, int threads) {
  const Posing<S> in = posing_input<S>(rest, weights, transforms);
  const Posed<S> out = posed_arrays<S>(moved, blended, kept, in.count);
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
  const int64_t n = in.count;
  const auto& [moved, blended, kept] = posed;
  const Posed<const S> forward = posed_arrays<const S>(moved, blended, kept, n);
  const auto& [by_means, by_quats, by_log_scales] = g;
  const auto& [g_means, g_quats, g_log_scales] = g_rest;
  const PosedGrads<S> grads{checked(by_means, n, 3, kOp), checked(by_quats, n, 4, kOp),
                            checked(by_log_scales, n, 3, kOp), checked(g_blended, n, 3, kOp)};
  const PosingGrads<S> out{checked(g_means, n, 3, kOp), checked(g_quats, n, 4, kOp), checked(g_log_scales, n, 3, kOp),
                           checked(g_weights, n, in.joints, kOp), checked(g_transforms, in.joints, 3, kOp)};
  nb::gil_scoped_release release;
  pose_backward(in, forward, grads, out, threads);
}

template <class S>
void bind_posing_of(nb::module_& module) {
  module.def(
      "pose_forward", pose_forward_arrays<S>, array("rest"), array("weights"), array("transforms"), array("moved"),
      array("blended"), array("kept"), nb::arg("num_threads"),
      "Writes moved means (N, 3), quaternions (N, 4) and log scales (N, 3), blended transforms (N, 3, 4) and what "
      "the backward pass needs (N, 12), from the same at rest, weights (N, J) and transforms (J, 3, 4).");
  module.def("pose_backward", pose_backward_arrays<S>, array("rest"), array("weights"), array("transforms"),
             array("posed"), array("g"), array("g_blended").none(), array("g_rest"), array("g_weights").none(),
             array("g_transforms"), nb::arg("num_threads"),
             "Writes gradients by all inputs, by the weights only if asked for.");
}

}  // namespace

void bind_posing(nb::module_& module) {
  for_each_scalar([&]<class S>() { bind_posing_of<S>(module); });
}

}  // namespace dyngs

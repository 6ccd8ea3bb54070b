// Python bindings of the slicing of 4D Gaussians. Argument unpacking only.
#include <algorithm>

#include "bind/arrays.hpp"
#include "core/api.hpp"

namespace dyngs {
namespace {

constexpr const char* kOp = "slicing";

// Quaternions, right quaternions, log scales, log spans.
template <class S>
using RotationsAndScales = std::tuple<Rows<S>, Rows<S>, Rows<S>, Array<S>>;
// Means, times, shapes, logits; of gradients likewise.
template <class S>
using SpaceTimeArrays = std::tuple<Rows<S>, Array<S>, RotationsAndScales<S>, Array<S>>;
// Means, quaternions, log scales, logits.
template <class S>
using SliceArrays = std::tuple<Rows<S>, Rows<S>, Rows<S>, Array<S>>;
template <class S>
using SliceBasis = Array<S, nb::shape<-1, 4, 3>>;

template <class S>
SpaceTimeGaussians<S> shape_input(const RotationsAndScales<const S>& arrays) {
  const auto& [quats, right_quats, log_scales, log_spans] = arrays;
  SpaceTimeGaussians<S> in{};
  in.count = quats.shape(0);
  in.quats = checked(quats, in.count, 4, kOp), in.right_quats = checked(right_quats, in.count, 4, kOp);
  in.log_scales = checked(log_scales, in.count, 3, kOp);
  in.log_spans = checked(log_spans, in.count, "slicing: log_spans");
  return in;
}

template <class S>
SpaceTimeGaussians<S> slicing_input(const SpaceTimeArrays<const S>& arrays) {
  const auto& [means, times, shapes, logits] = arrays;
  SpaceTimeGaussians<S> in = shape_input<S>(shapes);
  in.means = checked(means, in.count, 3, kOp);
  in.times = checked(times, in.count, "slicing: times");
  in.logit_opacities = checked(logits, in.count, "slicing: logit_opacities");
  return in;
}

template <class T>
Slice<T> slice_arrays(const SliceArrays<T>& arrays, const SliceBasis<T>& basis, int64_t count) {
  const auto& [means, quats, log_scales, logits] = arrays;
  return {checked(means, count, 3, kOp), checked(quats, count, 4, kOp), checked(log_scales, count, 3, kOp),
          checked(logits, count, "slicing: logit_opacities"), checked(basis, count, 4, kOp)};
}

template <class S>
void slice_forward_arrays(const SpaceTimeArrays<const S>& inputs, double time, double most_faded,
                          const SliceArrays<S>& sliced, const SliceBasis<S>& basis, int threads) {
  const SpaceTimeGaussians<S> in = slicing_input<S>(inputs);
  const SliceTime<S> at{static_cast<S>(time), static_cast<S>(most_faded)};
  const Slice<S> out = slice_arrays<S>(sliced, basis, in.count);
  nb::gil_scoped_release release;
  slice_forward(in, at, out, threads);
}

template <class S>
void slice_backward_arrays(const SpaceTimeArrays<const S>& inputs, double time, double most_faded,
                           const SliceArrays<const S>& sliced, const SliceBasis<const S>& basis,
                           const SliceArrays<const S>& g, const SpaceTimeArrays<S>& grads, int threads) {
  const SpaceTimeGaussians<S> in = slicing_input<S>(inputs);
  const SliceTime<S> at{static_cast<S>(time), static_cast<S>(most_faded)};
  const Slice<const S> slice = slice_arrays<const S>(sliced, basis, in.count);
  const Slice<const S> by = slice_arrays<const S>(g, basis, in.count);
  const auto& [means, times, shapes, logits] = grads;
  const auto& [quats, right_quats, log_scales, log_spans] = shapes;
  const SpaceTimeGrads<S> out{checked(means, in.count, 3, kOp),
                              checked(times, in.count, "slicing: times"),
                              checked(quats, in.count, 4, kOp),
                              checked(right_quats, in.count, 4, kOp),
                              checked(log_scales, in.count, 3, kOp),
                              checked(log_spans, in.count, "slicing: log_spans"),
                              checked(logits, in.count, "slicing: logit_opacities")};
  nb::gil_scoped_release release;
  slice_backward<S>(in, at, slice, {by.means, by.quats, by.log_scales, by.logit_opacities}, out, threads);
}

template <class S>
void condition_arrays(const RotationsAndScales<const S>& shapes, const SliceArrays<S>& outputs, int threads) {
  const SpaceTimeGaussians<S> in = shape_input<S>(shapes);
  const auto& [velocities, quats, log_scales, log_deviations] = outputs;
  const Conditional<S> out{checked(quats, in.count, 4, kOp), checked(log_scales, in.count, 3, kOp),
                           checked(velocities, in.count, 3, kOp),
                           checked(log_deviations, in.count, "slicing: log_deviations")};
  nb::gil_scoped_release release;
  condition(in, out, threads);
}

// Harmonics (A, K, 3) and (M, N K, 3), rows of the latter, elapsed times, and what is seen.
template <class S>
using TimeHarmonicsArrays = std::tuple<Array<const S, nb::ndim<3>>, Array<const S, nb::ndim<3>>,
                                       MaybeArray<const int64_t>, Array<const S>, Array<const bool>>;

template <class S>
TimeHarmonics<S> time_harmonics_input(const TimeHarmonicsArrays<S>& arrays) {
  const auto& [sh, sh_time, rows, elapsed, seen] = arrays;
  const int64_t count = sh.shape(0), width = sh.shape(1) * sh.shape(2), stored = sh_time.shape(0);
  const int64_t size = sh_time.shape(1) * sh_time.shape(2);
  if (width == 0 || size % width != 0) throw nb::value_error("harmonics in time: arrays of different sizes");
  const auto wrong = [stored](int64_t row) { return row < 0 || row >= stored; };
  const bool all_exist =
      rows ? kOnGpu || std::none_of(rows->data(), rows->data() + rows->size(), wrong) : count <= stored;
  if (!all_exist) throw nb::index_error("harmonics in time: no such row");
  return {count,
          width,
          size / width,
          sh.data(),
          sh_time.data(),
          checked(rows, count, "harmonics in time: rows"),
          checked(elapsed, count, "harmonics in time: elapsed"),
          checked(seen, count, "harmonics in time: seen")};
}

template <class S>
void time_harmonics_arrays(const TimeHarmonicsArrays<S>& arrays, const Array<S>& out, int threads) {
  const TimeHarmonics<S> in = time_harmonics_input<S>(arrays);
  S* to = checked(out, in.count * in.width, "harmonics in time: out");
  nb::gil_scoped_release release;
  time_harmonics(in, to, threads);
}

template <class S>
void time_harmonics_backward_arrays(const TimeHarmonicsArrays<S>& arrays, const Array<const S>& g,
                                    const Array<S>& by_sh_time, const Array<S>& by_elapsed, int threads) {
  const TimeHarmonics<S> in = time_harmonics_input<S>(arrays);
  const S* by = checked(g, in.count * in.width, "harmonics in time: g");
  const int64_t stored = std::get<1>(arrays).size();
  S* to = checked(by_sh_time, stored, "harmonics in time: by_sh_time");
  S* to_elapsed = checked(by_elapsed, in.count, "harmonics in time: by_elapsed");
  nb::gil_scoped_release release;
  time_harmonics_backward(in, by, to, to_elapsed, threads);
}

template <class S>
void bind_slicing_of(nb::module_& module) {
  module.def("slice_forward", slice_forward_arrays<S>, array("gaussians"), nb::arg("time"), nb::arg("most_faded"),
             array("sliced"), array("basis"), nb::arg("num_threads"),
             "Writes means (M, 3), quaternions (M, 4), log scales (M, 3) and opacity logits (M,) at a time, and what "
             "the backward pass needs (M, 4, 3), from means, times (M,), quaternions, right quaternions, log scales, "
             "log spans (M,) and logits.");
  module.def("slice_backward", slice_backward_arrays<S>, array("gaussians"), nb::arg("time"), nb::arg("most_faded"),
             array("sliced"), array("basis"), array("g"), array("grads"), nb::arg("num_threads"),
             "Writes gradients by all inputs.");
  module.def("condition", condition_arrays<S>, array("shapes"), array("outputs"), nb::arg("num_threads"),
             "Writes velocities (M, 3), quaternions (M, 4), log scales (M, 3) and log standard deviations of time "
             "(M,), from quaternions, right quaternions, log scales and log spans.");
  module.def("time_harmonics", time_harmonics_arrays<S>, array("harmonics"), array("out"), nb::arg("num_threads"),
             "Writes harmonics (A, K, 3) at a time.");
  module.def("time_harmonics_backward", time_harmonics_backward_arrays<S>, array("harmonics"), array("g"),
             array("by_sh_time"), array("by_elapsed"), nb::arg("num_threads"),
             "Writes gradients by the cosines' coefficients, in the named rows, and by the elapsed times.");
}

}  // namespace

void bind_slicing(nb::module_& module) {
  for_each_scalar([&]<class S>() { bind_slicing_of<S>(module); });
}

}  // namespace dyngs

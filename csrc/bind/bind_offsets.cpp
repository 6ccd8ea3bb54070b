// Python binding of the offsets of a deformation field. Argument unpacking only.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <optional>
#include <tuple>

#include "bind/arrays.hpp"
#include "core/api.hpp"

namespace nb = nanobind;

namespace dyngs {
namespace {

template <class S>
using Maybe = std::optional<Array<const S>>;

template <class A>
auto checked(const A& array, int64_t count) -> decltype(array.data()) {
  if (static_cast<int64_t>(array.size()) != count) throw nb::value_error("offsets: arrays of different sizes");
  return array.data();
}
template <class T>
const T* checked(const std::optional<Array<const T>>& array, int64_t count) {
  return array ? checked(*array, count) : nullptr;
}

template <class S>
void add(const std::tuple<Array<S>, Array<S>, Array<S>, Array<S>, Array<S>>& gaussians, const Maybe<int64_t>& rows,
         const std::tuple<Array<const S>, Maybe<S>, Maybe<S>, Maybe<S>, Maybe<S>>& offsets, int threads) {
  const auto& [means, quats, log_scales, logit_opacities, sh] = gaussians;
  const auto& [by_means, by_quats, by_log_scales, by_logit_opacities, by_colors] = offsets;
  if (by_means.ndim() != 2) throw nb::value_error("offsets: arrays of different sizes");
  const int64_t n = logit_opacities.size(), count = by_means.shape(0);
  const auto wrong = [n](int64_t row) { return row < 0 || row >= n; };
  const bool all_exist =
      rows ? !kReadable || std::none_of(rows->data(), rows->data() + rows->size(), wrong) : count <= n;
  if (!all_exist) throw nb::index_error("offsets: no such Gaussian");
  const RowOffsets<S> from{count,
                           checked(rows, count),
                           checked(by_means, 3 * count),
                           checked(by_quats, 4 * count),
                           checked(by_log_scales, 3 * count),
                           checked(by_logit_opacities, count),
                           checked(by_colors, 3 * count)};
  const int64_t stride = n ? static_cast<int64_t>(sh.size()) / n : 0;
  const MovedGaussians<S> to{checked(means, 3 * n),
                             checked(quats, 4 * n),
                             checked(log_scales, 3 * n),
                             logit_opacities.data(),
                             sh.data(),
                             stride};
  if (by_colors && n && stride < 3) throw nb::value_error("offsets: arrays of different sizes");
  nb::gil_scoped_release release;
  add_offsets(from, to, threads);
}

}  // namespace

void bind_offsets(nb::module_& module) {
  module.def("add_offsets", add<float>);
  module.def("add_offsets", add<double>);
}

}  // namespace dyngs

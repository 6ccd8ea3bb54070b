// Python binding of the offsets of a deformation field. Argument unpacking only.
#include <algorithm>

#include "bind/arrays.hpp"
#include "core/api.hpp"

namespace dyngs {
namespace {

template <class S>
using Maybe = MaybeArray<const S>;

template <class S>
void add(const std::tuple<Array<S>, Array<S>, Array<S>, Array<S>, Array<S>>& gaussians, const Maybe<int64_t>& rows,
         const std::tuple<Array<const S>, Maybe<S>, Maybe<S>, Maybe<S>, Maybe<S>>& offsets, int threads) {
  const auto& [means, quats, log_scales, logit_opacities, sh] = gaussians;
  const auto& [by_means, by_quats, by_log_scales, by_logit_opacities, by_colors] = offsets;
  if (by_means.ndim() != 2) throw nb::value_error("offsets: arrays of different sizes");
  const int64_t n = logit_opacities.size(), count = by_means.shape(0);
  const auto wrong = [n](int64_t row) { return row < 0 || row >= n; };
  const bool all_exist = rows ? kOnGpu || std::none_of(rows->data(), rows->data() + rows->size(), wrong) : count <= n;
  if (!all_exist) throw nb::index_error("offsets: no such Gaussian");
  const RowOffsets<S> from{count,
                           checked(rows, count, "offsets: rows"),
                           checked(by_means, 3 * count, "offsets: by_means"),
                           checked(by_quats, 4 * count, "offsets: by_quats"),
                           checked(by_log_scales, 3 * count, "offsets: by_log_scales"),
                           checked(by_logit_opacities, count, "offsets: by_logit_opacities"),
                           checked(by_colors, 3 * count, "offsets: by_colors")};
  const int64_t stride = n ? static_cast<int64_t>(sh.size()) / n : 0;
  const MovedGaussians<S> to{checked(means, 3 * n, "offsets: means"),
                             checked(quats, 4 * n, "offsets: quats"),
                             checked(log_scales, 3 * n, "offsets: log_scales"),
                             logit_opacities.data(),
                             sh.data(),
                             stride};
  if (by_colors && n && stride < 3) throw nb::value_error("offsets: arrays of different sizes");
  nb::gil_scoped_release release;
  add_offsets(from, to, threads);
}

// `gaussians`: gradients by means, log scales, logits, harmonics; `results`: by the offsets, in their order.
template <class S>
void add_backward(const std::tuple<Maybe<S>, Maybe<S>, Maybe<S>, Maybe<S>>& gaussians, const Maybe<int64_t>& rows,
                  const std::tuple<Maybe<S>, Maybe<S>, MaybeArray<S>>& quats,
                  const std::tuple<MaybeArray<S>, MaybeArray<S>, MaybeArray<S>, MaybeArray<S>, MaybeArray<S>>& results,
                  int64_t count, int64_t n, int threads) {
  if (count == 0) return;  // and so no pointers
  const auto& [means, log_scales, logits, sh] = gaussians;
  const auto& [own, by, by_own] = quats;
  const auto& [by_means, by_quats, by_log_scales, by_logits, by_colors] = results;
  const RowOffsets<S> from{count,   checked(rows, count, "offsets: rows"),
                           nullptr, checked(by, 4 * count, "offsets: quats"),
                           nullptr, nullptr,
                           nullptr};
  const int64_t stride = sh && n ? static_cast<int64_t>(sh->size()) / n : 0;
  const OffsetGrads<S> grads{checked(means, 3 * n, "offsets: means"),
                             checked(log_scales, 3 * n, "offsets: log_scales"),
                             checked(logits, n, "offsets: logit_opacities"),
                             checked(sh, stride * n, "offsets: sh"),
                             stride,
                             checked(by_means, 3 * count, "offsets: by_means"),
                             checked(by_quats, 4 * count, "offsets: by_quats"),
                             checked(by_log_scales, 3 * count, "offsets: by_log_scales"),
                             checked(by_logits, count, "offsets: by_logit_opacities"),
                             checked(by_colors, 3 * count, "offsets: by_colors"),
                             checked(by_own, 4 * n, "offsets: quats")};
  const S* before = checked(own, 4 * n, "offsets: quats");
  const auto differs = [](const void* a, const void* b) { return (a == nullptr) != (b == nullptr); };
  if (differs(grads.means, grads.by_means) || differs(grads.log_scales, grads.by_log_scales) ||
      differs(grads.logit_opacities, grads.by_logit_opacities) || differs(grads.sh, grads.by_colors) ||
      differs(grads.quats, grads.by_quats) || (grads.quats && (!before || !from.quats)))
    throw nb::value_error("offsets: arrays that do not belong together");
  nb::gil_scoped_release release;
  add_offsets_backward(from, before, grads, threads);
}

}  // namespace

void bind_offsets(nb::module_& module) {
  for_each_scalar([&]<class S>() {
    module.def("add_offsets", add<S>);
    module.def("add_offsets_backward", add_backward<S>);
  });
}

}  // namespace dyngs

// Offsets of a deformation field, added to Gaussians in place.
#include "core/api.hpp"

#include "cpu/parallel.hpp"
#include "math/quaternion.hpp"

namespace dyngs {
namespace {

constexpr int64_t kGrain = 2048;

template <class S>
void add3(S* to, const S* by) {
  for (int c = 0; c < 3; ++c) to[c] += by[c];
}

template <class S>
void turn(S* q, const S* by) {
  const Quat<S> turned = Quat<S>{by[0] + 1, by[1], by[2], by[3]} * load_quat(q);
  q[0] = turned.w, q[1] = turned.x, q[2] = turned.y, q[3] = turned.z;
}

template <class S>
void put3(S* to, const S* from) {
  for (int c = 0; c < 3; ++c) to[c] = from[c];
}

template <class S>
void put_quat(S* to, const Quat<S>& q) {
  to[0] = q.w, to[1] = q.x, to[2] = q.y, to[3] = q.z;
}

}  // namespace

template <class S>
void add_offsets(const RowOffsets<S>& offsets, const MovedGaussians<S>& gaussians, int threads) {
  parallel_for(offsets.count, kGrain, threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const int64_t row = offsets.rows ? offsets.rows[i] : i;
      add3(gaussians.means + 3 * row, offsets.means + 3 * i);
      if (offsets.quats) turn(gaussians.quats + 4 * row, offsets.quats + 4 * i);
      if (offsets.log_scales) add3(gaussians.log_scales + 3 * row, offsets.log_scales + 3 * i);
      if (offsets.logit_opacities) gaussians.logit_opacities[row] += offsets.logit_opacities[i];
      if (offsets.colors) add3(gaussians.sh + gaussians.sh_stride * row, offsets.colors + 3 * i);
    }
  });
}

template <class S>
void add_offsets_backward(const RowOffsets<S>& offsets, const S* quats, const OffsetGrads<S>& g, int threads) {
  parallel_for(offsets.count, kGrain, threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const int64_t row = offsets.rows ? offsets.rows[i] : i;
      if (g.by_means) put3(g.by_means + 3 * i, g.means + 3 * row);
      if (g.by_log_scales) put3(g.by_log_scales + 3 * i, g.log_scales + 3 * row);
      if (g.by_logit_opacities) g.by_logit_opacities[i] = g.logit_opacities[row];
      if (g.by_colors) put3(g.by_colors + 3 * i, g.sh + g.sh_stride * row);
      if (!g.by_quats) continue;
      const Quat<S> by = load_quat(g.quats + 4 * row), offset = load_quat(offsets.quats + 4 * i);
      put_quat(g.by_quats + 4 * i, by * conjugate(load_quat(quats + 4 * row)));
      put_quat(g.quats + 4 * row, conjugate(Quat<S>{offset.w + 1, offset.x, offset.y, offset.z}) * by);
    }
  });
}

template void add_offsets_backward(const RowOffsets<float>&, const float*, const OffsetGrads<float>&, int);
template void add_offsets_backward(const RowOffsets<double>&, const double*, const OffsetGrads<double>&, int);
template void add_offsets<float>(const RowOffsets<float>&, const MovedGaussians<float>&, int);
template void add_offsets<double>(const RowOffsets<double>&, const MovedGaussians<double>&, int);

}  // namespace dyngs

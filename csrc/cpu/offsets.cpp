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

template void add_offsets<float>(const RowOffsets<float>&, const MovedGaussians<float>&, int);
template void add_offsets<double>(const RowOffsets<double>&, const MovedGaussians<double>&, int);

}  // namespace dyngs

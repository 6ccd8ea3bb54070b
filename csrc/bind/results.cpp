// Results of the CPU module.
#include "bind/results.hpp"

#include <algorithm>
#include <limits>
#include <utility>
#include <vector>

namespace dyngs {
namespace {

// Hands a vector to Python without copying it.
template <class T>
nb::ndarray<nb::numpy, T, nb::ndim<1>> release_vector(std::vector<T>&& vector) {
  auto* owner = new std::vector<T>(std::move(vector));
  nb::capsule free(owner, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return {owner->data(), {owner->size()}, free};
}

void add(int32_t* to, int64_t count) {
  *to = static_cast<int32_t>(std::min<int64_t>(*to + count, std::numeric_limits<int32_t>::max()));
}

}  // namespace

template <class S>
nb::tuple binned(const Splats<S>& splats, int64_t max_entries) {
  Binning binning;
  {
    nb::gil_scoped_release release;
    binning = bin_tiles(splats, max_entries);
  }
  return nb::make_tuple(release_vector(std::move(binning.tile_offsets)), release_vector(std::move(binning.slot_ranges)),
                        release_vector(std::move(binning.gaussians)), release_vector(std::move(binning.slots)));
}
template nb::tuple binned(const Splats<float>&, int64_t);
template nb::tuple binned(const Splats<double>&, int64_t);

void write_l1_ssim(const LossInput& input, double* loss, float* gradient, int threads) {
  *loss = l1_ssim_loss(input, gradient, threads);
}

template <class S>
void write_plane_penalty(const HexPlane<S>& planes, const PenaltyWeights& weights, std::span<const PlaneGrads<S>> grads,
                         double* penalty, int threads) {
  *penalty = plane_penalty<S>(planes, weights, grads, threads);
}
template void write_plane_penalty(const HexPlane<float>&, const PenaltyWeights&, std::span<const PlaneGrads<float>>,
                                  double*, int);
template void write_plane_penalty(const HexPlane<double>&, const PenaltyWeights&, std::span<const PlaneGrads<double>>,
                                  double*, int);

void write_adam_step(const AdamState& state, const AdamRates& rates, int32_t* skipped, int threads) {
  add(skipped, adam_step(state, rates, threads));
}

template <class S>
void write_count_nonfinite(const S* x, int64_t n, int32_t* count, int threads) {
  add(count, count_nonfinite(x, n, threads));
}
template void write_count_nonfinite(const float*, int64_t, int32_t*, int);
template void write_count_nonfinite(const double*, int64_t, int32_t*, int);

}  // namespace dyngs

// Results that differ between CPU and GPU: scalars stay in GPU memory, because reading them back would synchronise, and
// the lists of tile entries are allocated by torch.
#pragma once

#include "bind/arrays.hpp"
#include "core/api.hpp"

namespace dyngs {

// The four arrays of bin_tiles, one-dimensional: of NumPy, or on a GPU tensors of bytes.
template <class S>
nb::tuple binned(const Splats<S>& splats, int64_t max_entries);

void write_l1_ssim(const LossInput& input, double* loss, float* gradient, int threads);
template <class S>
void write_plane_penalty(const HexPlane<S>& planes, const PenaltyWeights& weights, std::span<const PlaneGrads<S>> grads,
                         double* penalty, int threads);
// These two add to what is there.
void write_adam_step(const AdamState& state, const AdamRates& rates, int32_t* skipped, int threads);
template <class S>
void write_count_nonfinite(const S* x, int64_t n, int32_t* count, int threads);

}  // namespace dyngs

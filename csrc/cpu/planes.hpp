// Features from factored space-time grids (HexPlane, Cao and Johnson 2023; K-Planes, Fridovich-Keil et al. 2023), as
// 4DGS (Wu et al. 2024) uses them: three planes over space and three over time per level, multiplied; levels
// concatenated.
#pragma once

#include <cstdint>
#include <vector>

namespace dyngs {

// Channels last. The first axis of a name is the fast one: `space` holds xy, xz, yz with rows y, z, z; `time` holds
// xt, yt, zt with rows t.
template <class S>
struct PlaneLevel {
  const S* space;  // (3, size, size, C)
  const S* time;   // (3, times, size, C)
  int64_t size;
  int64_t times;
};

template <class S>
struct PlaneGrads {
  S* space;
  S* time;
};

template <class S>
struct HexPlane {
  std::vector<PlaneLevel<S>> levels;
  int64_t channels;
  double time;  // in [0, 1]
};

// Points (count, 3) in [-1, 1]; what lies outside is clamped, NaN gives NaN.
template <class S>
struct PlanePoints {
  const S* coords;
  int64_t count;
};

// Writes features (count, L * C), and into `order` (count) the sequence in which neighbours follow each other.
template <class S>
void hexplane_forward(const HexPlane<S>& planes, const PlanePoints<S>& points, S* features, int32_t* order,
                      int num_threads);

// Gradients of sum(features * g_features), by the planes (written in full) and, unless nullptr, the points (count, 3).
// `order` comes from the forward pass. The result does not depend on num_threads.
template <class S>
void hexplane_backward(const HexPlane<S>& planes, const PlanePoints<S>& points, const int32_t* order,
                       const S* g_features, const std::vector<PlaneGrads<S>>& grads, S* g_coords, int num_threads);

struct PenaltyWeights {
  double space;  // of the mean squared second difference along the two axes of space planes, averaged over the axes
  double time;   // of that along the time axis of time planes
  double one;    // of the mean of |1 - plane| of time planes
};

// Sum over all planes of the weighted penalties. Writes its gradient into `grads` unless that is empty. The result does
// not depend on num_threads.
template <class S>
double plane_penalty(const HexPlane<S>& planes, const PenaltyWeights& weights,
                     const std::vector<PlaneGrads<S>>& grads, int num_threads);

}  // namespace dyngs

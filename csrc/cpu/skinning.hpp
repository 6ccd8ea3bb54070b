// Linear blend skinning of points by sparse control nodes, as in SC-GS (Huang et al. 2024): every point x follows B of
// the S nodes, each of which turns it about its own place p and shifts it,
//   offset = sum_b w_b (R_b a_b - a_b + d_b),  a_b = x - p_b,  w = softmax_b(-|a_b|^2 / (2 radius_b^2)).
// Anything else that nodes carry is blended with the same weights. These are constant with respect to gradients.
#pragma once

#include <cstdint>

namespace dyngs {

template <class S>
struct SkinNodes {
  const S* positions;  // (count, 3)
  const S* radii;      // (count,), positive
  const S* motion;     // (count, 7): shift d, quaternion wxyz of any length (zero = identity)
  const S* values;     // (count, width)
  int64_t count, width;
};

template <class S>
struct SkinPoints {
  const S* coords;          // (count, 3)
  const int64_t* followed;  // (count, nodes), each in [0, SkinNodes::count)
  int64_t count, nodes;
};

template <class S>
struct Skinned {
  S* offset;   // (count, 3)
  S* blended;  // (count, width)
  S* weights;  // (count, nodes)
};

template <class S>
struct SkinGrads {
  S* points;  // (count, 3) of the offset alone, or nullptr
  S* motion;  // (S, 7)
  S* values;  // (S, width)
};

// Whether all indices are in [0, num_nodes).
bool follow_within(const int64_t* followed, int64_t size, int64_t num_nodes);

template <class S>
void skinning_forward(const SkinNodes<S>& nodes, const SkinPoints<S>& points, const Skinned<S>& out, int num_threads);

// Gradients of sum(offset * g.offset) + sum(blended * g.blended), all written in full; g.weights holds the weights that
// the forward pass wrote. The result does not depend on num_threads.
template <class S>
void skinning_backward(const SkinNodes<S>& nodes, const SkinPoints<S>& points, const Skinned<const S>& g,
                       const SkinGrads<S>& grads, int num_threads);

}  // namespace dyngs

// Linear blend skinning of a point by a control node (SC-GS, Huang et al. 2024): the node at p with rotation R and shift d
// moves a point x by R a - a + d, a = x - p, with a weight of exp(-|a|^2 / (2 radius^2)) over the sum of all nodes'.
// V is a vector of three numbers (Vec3, or four lanes with a spare one), S one number.
#pragma once

#include "math/quaternion.hpp"

namespace dyngs {

// Minus the factor of |a|^2 in the weight's exponent, as a power of two; not infinite for the smallest radius.
template <class S>
DYNGS_HD S weight_decay(double radius) {
  const double most = kLargest<S>, rate = 0.5 * 1.4426950408889634 / (radius * radius);  // log2(e) / 2 / radius^2
  return -static_cast<S>(most < rate ? most : rate);
}

// log2 of a weight before normalisation. Distances that overflow all count as equal; NaN stays.
template <class V, class S>
DYNGS_HD S weight_exponent(const V& arm, S decay) {
  const S lowest = -kLargest<S>;
  const S exponent = (arm[0] * arm[0] + arm[1] * arm[1] + arm[2] * arm[2]) * decay;
  return exponent < lowest ? lowest : exponent;
}

// R - I of a quaternion of any length; zero gives that of the identity, NaN stays.
template <class S>
DYNGS_HD Mat3<S> turn_of(const Quat<S>& q) {
  if (q.w != q.w || q.x != q.x || q.y != q.y || q.z != q.z) {
    const S nan = kNaN<S>;
    return {{{nan, nan, nan}, {nan, nan, nan}, {nan, nan, nan}}};
  }
  S inv_norm;
  return rotation_minus_identity(normalize(q, inv_norm));
}

template <class S>
DYNGS_HD Quat<S> turn_vjp(const Quat<S>& q, const Mat3<S>& g) {
  S inv_norm;
  const Quat<S> unit = normalize(q, inv_norm);
  return normalize_vjp(unit, inv_norm, rotation_matrix_vjp(unit, g));
}

// Motion of a point by one node; `columns`: those of R - I.
template <class V>
DYNGS_HD V moved_by(const V* columns, const V& shift, const V& arm) {
  return dot3(columns[0], arm[0], columns[1], arm[1], columns[2], arm[2]) + shift;
}

// Adds the gradients by the columns of R - I and by the shift, with g = weight * dL/d(offset); adds to `by_point` the part
// of that by the point, through `rows` of R - I.
template <class V>
DYNGS_HD void moved_by_vjp(const V* rows, const V& arm, const V& g, V* by_columns, V& by_shift, V& by_point) {
  for (int i = 0; i < 3; ++i) {
    by_point = by_point + rows[i] * g[i];
    by_columns[i] = by_columns[i] + g * arm[i];
  }
  by_shift = by_shift + g;
}

}  // namespace dyngs

// Inputs of the network for compact colour (MEGA, Zhang et al. 2024):
// position, direction and normal of a Gaussian.
#pragma once

#include "math/quaternion.hpp"

namespace dyngs {

// The axis of the rotation `q` that belongs to the smallest of the scales, of equal ones the first.
template <class S>
DYNGS_HD Vec3<S> shortest_axis(const Quat<S>& q, const S* log_scales) {
  S inv_norm;  // for a gradient, which is not needed
  const Quat<S> n = normalize(q, inv_norm);
  const S w = n.w, x = n.x, y = n.y, z = n.z;
  const S* least = log_scales;
  for (int k = 1; k < 3; ++k)
    if (log_scales[k] < *least) least = log_scales + k;
  switch (least - log_scales) {
    case 0: return {1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)};
    case 1: return {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)};
    default: return {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)};
  }
}

// x within the unit ball; all outside it contracted into a ball of radius 2 (Barron et al. 2022).
template <class S>
DYNGS_HD Vec3<S> contracted(const Vec3<S>& x) {
  const S length = max(S(1), norm(x));  // NaN stays
  return x * ((2 - 1 / length) / length);
}

// d - 2 <d, n> n, with `cosine` <d, n>.
template <class S>
DYNGS_HD Vec3<S> reflected(const Vec3<S>& d, const Vec3<S>& n, S cosine) {
  const S twice = 2 * cosine;
  return {d.x - twice * n.x, d.y - twice * n.y, d.z - twice * n.z};
}

}  // namespace dyngs

// Discontinuity-aware weights of a Gaussian's alpha near the outline of the patch that it lies on (BG-Triangle, Wu et al. 2025).
// rho is the distance of a pixel from the nearest sample of that outline, in radii. The weight is 2^rho / 2 where the pixel shows
// the patch, and 1 - 2^rho / 2 elsewhere: a half at the outline, 1 inside and 0 outside from rho = 1 on. R is one pixel or several.
#pragma once

#include "math/scalar.hpp"

namespace dyngs {

// Nearer than this the direction to a sample is noise: flat faces are off their patch by as much.
inline constexpr double kLeastOffset = 0.1;  // px

template <class R>
DYNGS_INLINE R boundary_weight(R rho, MaskOf<R> inside) {
  const R one = real<R>(1), half = min(exp2(min(rho, one) - one), one);
  return select(inside, half, one - half);
}

// The derivative of the weight's natural logarithm by rho < 1.
template <class S>
DYNGS_HD S boundary_log_slope(S weight, bool inside) {
  const S slope = S(0.6931471805599453);
  return inside ? slope : slope * (weight - S(1)) / max(weight, kEpsilon<S>);
}

}  // namespace dyngs

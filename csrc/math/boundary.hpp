// Discontinuity-aware weights of a Gaussian's alpha near the outline of the patch that it lies on (BG-Triangle, Wu et al. 2025).
// rho is the distance of a pixel from the nearest sample of that outline in radii. The weight is 2^rho / 2 where the pixel shows
// the patch, and 1 - 2^rho / 2 elsewhere: a half at the outline, 1 inside and 0 outside from rho = 1 on. Logarithms are to base 2.
#pragma once

#include "math/scalar.hpp"

namespace dyngs {

// Nearer than this the direction to a sample is noise: flat faces are off their patch by as much.
inline constexpr double kLeastOffset = 0.1;  // px

// For rho < 1.
template <class S>
DYNGS_HD S log2_boundary_weight(S rho, bool inside) {
  return inside ? rho - S(1) : log2(S(1) - exp2(rho - S(1)));
}

// Its derivative by rho.
template <class S>
DYNGS_HD S log2_boundary_slope(S rho, bool inside) {
  const S half = exp2(rho - S(1));
  return inside ? S(1) : -half / max(S(1) - half, kEpsilon<S>);
}

}  // namespace dyngs

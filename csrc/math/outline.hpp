// How much a primitive counts at a pixel near its outline: BG-Triangle's weight of a distance (Wu et al. 2025), in units of
// the radius of the outline. It runs from 1 inside to 1/2 at the outline, and from there to 0 outside.
#pragma once

#include "math/scalar.hpp"

namespace dyngs {

inline constexpr double kLn2 = 0.6931471805599453;

// Distance to the outline, px, below which its direction is noise, so that no gradient flows.
inline constexpr double kOnOutline = 0.1;

// `rho`: the distance over the radius; 1 or more: the outline is far.
template <class S>
DYNGS_HD S outline_weight(bool inside, S rho) {
  if (!(rho < S(1))) return inside ? S(1) : S(0);
  const S half = S(0.5) * exp2(rho);
  return inside ? half : S(1) - half;
}

// Its derivative by rho, at rho < 1.
template <class S>
DYNGS_HD S outline_slope(bool inside, S rho) {
  const S slope = S(0.5) * S(kLn2) * exp2(rho);
  return inside ? slope : -slope;
}

}  // namespace dyngs

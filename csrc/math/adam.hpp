// Adam (Kingma and Ba 2015), one element:
//   m <- m + (1 - beta1) (g - m),   v <- beta2 v + (1 - beta2) g^2
//   p <- p - rate / (1 - beta1^t) * m / (sqrt(v) / sqrt(1 - beta2^t) + eps)
#pragma once

#include "math/scalar.hpp"

namespace dyngs {

template <class S>
struct AdamCoefficients {
  S one_minus_beta1;
  S beta2;
  S one_minus_beta2;
  S inv_sqrt_correction2;  // 1 / sqrt(1 - beta2^t)
  S eps;
};

template <class S>
struct AdamElement {
  S param, exp_avg, exp_avg_sq;
};

// `rate`: that of learning over 1 - beta1^t.
template <class S>
DYNGS_HD AdamElement<S> adam_update(const AdamElement<S>& at, S grad, S rate, const AdamCoefficients<S>& c) {
  const S m = at.exp_avg + c.one_minus_beta1 * (grad - at.exp_avg);
  const S v = c.beta2 * at.exp_avg_sq + c.one_minus_beta2 * grad * grad;
  return {at.param - rate * m / (sqrt(v) * c.inv_sqrt_correction2 + c.eps), m, v};
}

}  // namespace dyngs

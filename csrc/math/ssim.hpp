// SSIM of two images at one pixel, from blurred maps, and its partial derivatives by these.
//
// With x the rendered and y the target image, G the 11-tap Gaussian blur with zero padding, d = x - y and s = x + y:
//   P = (G(d)^2 + G(s)^2) / 2 + C1                      = mean_x^2 + mean_y^2 + C1
//   V_d = G(d^2) - G(d)^2,  V_s = G(s^2) - G(s)^2
//   Q = (V_d + V_s) / 2 + C2                            = var_x + var_y + C2
//   P - G(d)^2 = 2 mean_x mean_y + C1,  Q - V_d = 2 cov_xy + C2
//   SSIM = (1 - G(d)^2 / P) * (1 - V_d / Q)
// which is the usual formula, but needs four blurs instead of five and has no cancellation where x is close to y:
// equal images give exactly 0 loss.
//
// Gradient. Write SSIM = l * c with e = G(d)^2 / P = 1 - l and f = V_d / Q = 1 - c. The partial derivatives by the four
// blurred maps are, per pixel,
//   A_dd = dSSIM/dG(d^2) = l * (f / 2 - 1) / Q          A_ss = dSSIM/dG(s^2) = l * (f / 2) / Q
//   A_d  = dSSIM/dG(d)   = c * (e - 2) / P * G(d) - 2 * G(d) * A_dd
//   A_s  = dSSIM/dG(s)   = c * e / P * G(s)       - 2 * G(s) * A_ss
// As dd/dx = ds/dx = 1 and G is its own adjoint (symmetric kernel, zero padding),
//   dSSIM/dx = G(A_d + A_s) + 2 d G(A_dd) + 2 s G(A_ss).
#pragma once

#include "math/scalar.hpp"

namespace dyngs {

inline constexpr double kSsimC1 = 0.01 * 0.01;
inline constexpr double kSsimC2 = 0.03 * 0.03;

// The Gaussian G along one axis, of standard deviation 1.5.
inline constexpr int kSsimRadius = 5, kSsimTaps = 2 * kSsimRadius + 1;
template <class T>
struct SsimKernel {
  T tap[kSsimTaps];
};

template <class T>
SsimKernel<T> ssim_kernel() {
  double value[kSsimTaps], sum = 0;
  for (int i = 0; i < kSsimTaps; ++i)
    sum += value[i] = std::exp(-(i - kSsimRadius) * (i - kSsimRadius) / (2 * 1.5 * 1.5));
  SsimKernel<T> kernel;
  for (int i = 0; i < kSsimTaps; ++i) kernel.tap[i] = static_cast<T>(value[i] / sum);
  return kernel;
}

// G(d^2) + G(s^2) up to which float32 is precise: V = G(x^2) - G(x)^2 loses digits where x^2 is large beside C2; here 0.1% of Q.
inline constexpr double kLargestSquaresInFloat = 16;  // images up to 2

template <class R>
struct SsimTerms {
  R dissimilarity;                                 // 1 - SSIM
  R grad_mean, grad_diff_square, grad_sum_square;  // A_d + A_s, A_dd, A_ss
};

// A variance below zero is rounding; NaN stays NaN.
template <class R>
DYNGS_HD R at_least_zero(R x) {
  return max(real<R>(0), x);
}

// Of G(d), G(s), G(d^2), G(s^2).
template <class R>
DYNGS_HD SsimTerms<R> ssim_terms(R mean_d, R mean_s, R square_d, R square_s) {
  const R one = real<R>(1), two = real<R>(2), half = real<R>(0.5), c1 = real<R>(kSsimC1), c2 = real<R>(kSsimC2);
  const R mean_d2 = mean_d * mean_d, mean_s2 = mean_s * mean_s;
  const R var_d = at_least_zero(square_d - mean_d2), var_s = at_least_zero(square_s - mean_s2);
  const R inv_p = one / ((mean_d2 + mean_s2) * half + c1);
  const R inv_q = one / ((var_d + var_s) * half + c2);
  const R e = mean_d2 * inv_p, f = var_d * inv_q;
  const R l_over_q = (one - e) * inv_q, c_over_p = (one - f) * inv_p;
  SsimTerms<R> t;
  t.dissimilarity = e + f - e * f;
  t.grad_sum_square = l_over_q * (f * half);
  t.grad_diff_square = t.grad_sum_square - l_over_q;
  const R slope_d = c_over_p * (e - two), slope_s = c_over_p * e;
  const R grad_mean_d = mean_d * (slope_d - t.grad_diff_square * two);
  const R grad_mean_s = mean_s * (slope_s - t.grad_sum_square * two);
  t.grad_mean = grad_mean_d + grad_mean_s;
  return t;
}

// dSSIM/dx, of d, s and the blurred partial derivatives.
template <class R>
DYNGS_HD R ssim_grad(R d, R s, R blurred_mean, R blurred_diff_square, R blurred_sum_square) {
  const R two = real<R>(2);
  return blurred_mean + d * two * blurred_diff_square + s * two * blurred_sum_square;
}

// NaN passes through, as 0 does.
template <class R>
DYNGS_HD R sign(R x) {
  const R zero = real<R>(0), one = real<R>(1);
  return select(x > zero, one, select(x < zero, -one, x));
}

}  // namespace dyngs

// Alpha blending front to back, and its vjp back to front (3DGS, Kerbl et al. 2023). R is one pixel or the lanes of
// several, S the numbers of one Gaussian.
//
// Forward, with T the transmittance before a Gaussian: it adds weight = alpha T of its colour, and T <- T - weight.
// Backward, with the background as a last, opaque layer, s_i = <colour_i, dL/dC> and B what lies behind i (as the same
// scalar):  dL/dalpha_i = T_i (s_i - B),   B <- B + alpha_i (s_i - B).
//
// alpha = opacity exp(-(u^2 + v^2) / 2), u = U dx + W dy, v = V dy (math/covariance.hpp), d = mean - pixel. With
// p = dL/dlog alpha, the gradients of a Gaussian are linear in six sums over its pixels:
//   of p, p u, p v, p u dx, p u dy, p v dy.
#pragma once

#include "math/vec.hpp"

namespace dyngs {

inline constexpr double kLog2E = 1.4426950408889634;

// One Gaussian as the pixels read it. u, w, v are scaled by sqrt(log2(e) / 2), so that
// alpha = 2^(log2_opacity - u'^2 - v'^2).
template <class S>
struct BlendGaussian {
  S x, y, u, w, v, log2_opacity;
};

template <class S>
DYNGS_HD BlendGaussian<S> blend_gaussian(const S* mean, const S* factor, S opacity) {
  const S scale = sqrt(S(0.5) * S(kLog2E));
  return {mean[0], mean[1], factor[0] * scale, factor[1] * scale, factor[2] * scale, log2(opacity)};
}

// (u, v) at offset (x, y) from a pixel where it is `first`.
template <class R>
DYNGS_INLINE Vec2<R> whitened(R u, R w, R v, const Vec2<R>& first, R x, R y) {
  return {first.x - u * x - w * y, first.y - v * y};
}

// (u, v) of a pixel centre; `dx`, `dy`: the mean minus it.
template <class S>
DYNGS_INLINE Vec2<S> whitened_first(const BlendGaussian<S>& g, S dx, S dy) {
  return {g.u * dx + g.w * dy, g.v * dy};
}

// log2 of alpha before clamping, where (u, v) are `at`.
template <class R>
DYNGS_INLINE R log2_alpha(R log2_opacity, const Vec2<R>& at) {
  return log2_opacity - at.x * at.x - at.y * at.y;
}

// The same at offset (x, y) from some first pixel centre; `dx`, `dy`: the mean minus that centre.
template <class R, class S>
DYNGS_INLINE R log2_alpha(const BlendGaussian<S>& g, S dx, S dy, R x, R y) {
  const Vec2<S> first = whitened_first(g, dx, dy);
  return log2_alpha(R(g.log2_opacity), whitened(R(g.u), R(g.w), R(g.v), Vec2<R>{R(first.x), R(first.y)}, x, y));
}

// `raw`: alpha before clamping.
template <class R>
DYNGS_INLINE R clamped_alpha(R raw, R alpha_max, MaskOf<R> drawn) {
  return select(drawn, min(raw, alpha_max), real<R>(0));
}

template <class R>
struct BlendStep {
  R weight, transmittance;  // of the colour; after the Gaussian
  MaskOf<R> full;           // it would take the pixel below the least transmittance: it is not added, nor any after it
};

template <class R>
DYNGS_INLINE BlendStep<R> blend_step(R alpha, R transmittance, R transmittance_min) {
  const R weight = alpha * transmittance, next = transmittance - weight;
  return {weight, next, next < transmittance_min};  // alpha > 0 there: the transmittance before was not below it
}

// The step where full pixels are left as they were.
template <class R>
DYNGS_INLINE void leave_full(R before, BlendStep<R>& step) {
  step.weight = select(step.full, real<R>(0), step.weight);
  step.transmittance = select(step.full, before, step.transmittance);
}

// d(sum of channels) / dalpha = T (s - B), of a front-to-back pass that knows `behind` = T (alpha s + (1 - alpha) B), the
// light of this Gaussian and all after it; `own`: alpha T s, `shade`: s.
template <class R>
DYNGS_INLINE R slope_by_alpha(R alpha, R transmittance, R shade, R own, R behind) {
  return transmittance * shade - (behind - own) / (real<R>(1) - alpha);
}

// The state of the recursion back to front: behind the Gaussian on the way in, in front of it on the way out.
template <class R>
struct BlendBehind {
  R transmittance, light;  // T after the Gaussian; B
};

template <class R>
struct BlendGrad {
  R weight;        // dL/dcolour = weight * dL/dC
  R by_log_alpha;  // dL/dlog(alpha)
};

// `shade`: s. The clamp of alpha stops the gradient; `alpha` is 0 where the Gaussian was not drawn.
template <class R>
DYNGS_INLINE BlendGrad<R> blend_vjp(R raw, R alpha, R alpha_max, R shade, BlendBehind<R>& behind) {
  const R restore = real<R>(1) / (real<R>(1) - alpha);  // alpha <= alpha_max < 1; outside the chain of dependences
  behind.transmittance *= restore;
  const R gap = shade - behind.light;
  const R weight = alpha * behind.transmittance;
  behind.light += alpha * gap;
  return {weight, select(raw < alpha_max, weight * gap, real<R>(0))};
}

// Minus the gradient by the mean of one pixel's log alpha, times `p`, for u, w, v as in `at`.
template <class R>
DYNGS_INLINE Vec2<R> slope_by_mean(R p, R u, R w, R v, const Vec2<R>& at) {
  return {p * u * at.x, p * (w * at.x + v * at.y)};
}

// Six sums over pixels: of p times 1, x, y, x^2, x y, y^2.
enum PixelMoment { kOne, kX, kY, kXX, kXY, kYY };
// And of p, p u, p v, p u dx, p u dy, p v dy.
enum BlendSum { kP, kPU, kPV, kPUDx, kPUDy, kPVDy };
inline constexpr int kBlendSums = 6;

// The moments in offsets from (dx, dy) to the pixel, of those in the pixels' offsets.
template <class R>
DYNGS_INLINE void moments_about(const R (&m)[kBlendSums], R dx, R dy, R* to) {
  const R x = dx * m[kOne] - m[kX], y = dy * m[kOne] - m[kY];
  to[kOne] = m[kOne];
  to[kX] = x;
  to[kY] = y;
  to[kXX] = dx * (x - m[kX]) + m[kXX];
  to[kXY] = dx * y - dy * m[kX] + m[kXY];
  to[kYY] = dy * (y - m[kY]) + m[kYY];
}

// The sums, of moments about an anchor. `far`: the mean minus the anchor; `origin`: the point about which dx, dy of the sums
// are taken, minus the anchor. u, w, v are not scaled. All in double, since `far` and `origin` may be large.
template <class S>
DYNGS_HD void blend_sums(const S* m, double u, double w, double v, const Vec2<double>& far, const Vec2<double>& origin,
                         S* sums) {
  const double first_u = u * far.x + w * far.y, first_v = v * far.y;
  const double dx = m[kX], dy = m[kY];
  const double sum_u = first_u * m[kOne] + u * dx + w * dy, sum_v = first_v * m[kOne] + v * dy;
  sums[kP] = m[kOne];
  sums[kPU] = static_cast<S>(sum_u), sums[kPV] = static_cast<S>(sum_v);
  sums[kPUDx] = static_cast<S>(first_u * dx + u * m[kXX] + w * m[kXY] + origin.x * sum_u);
  sums[kPUDy] = static_cast<S>(first_u * dy + u * m[kXY] + w * m[kYY] + origin.y * sum_u);
  sums[kPVDy] = static_cast<S>(first_v * dy + v * m[kYY] + origin.y * sum_v);
}

// Gradients of one splat.
template <class S>
struct BlendSplatGrad {
  Vec2<S> mean;
  S u, w, v, opacity;
};

// From the sums over all its pixels. `far`: the mean minus the point about which they were taken.
template <class S>
DYNGS_HD BlendSplatGrad<S> splat_grad(const double* sum, double u, double w, double v, double opacity,
                                      const Vec2<double>& far) {
  return {{static_cast<S>(-u * sum[kPU]), static_cast<S>(-(w * sum[kPU] + v * sum[kPV]))},
          static_cast<S>(-(sum[kPUDx] + far.x * sum[kPU])),
          static_cast<S>(-(sum[kPUDy] + far.y * sum[kPU])),
          static_cast<S>(-(sum[kPVDy] + far.y * sum[kPV])),
          opacity > 0 ? static_cast<S>(sum[kP] / opacity) : S(0)};
}

}  // namespace dyngs

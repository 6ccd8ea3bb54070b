// The outline of a splat where alpha is alpha_min: the ellipse u^2 + v^2 <= t with u = U dx + W dy, v = V dy (math/covariance.hpp),
// its bounds, and the pixels between them. Templates over a scalar or a vector of lanes.
#pragma once

#include "math/vec.hpp"

namespace dyngs {

template <class R>
struct Ellipse {
  R x, y, u, w, v, t;
  R half_height;
  R tip;  // dy of the rightmost point
};

template <class R, class S>
DYNGS_HD Ellipse<R> visible_ellipse(R x, R y, R u, R w, R v, R opacity, S alpha_min) {
  const R unlimited = real<R>(1e30);  // alpha_min = 0: no pixel is negligible; finite, so that no NaN arises
  Ellipse<R> e{x, y, u, w, v, {}, {}, {}};
  e.t = min(real<R>(2) * log(opacity / R(alpha_min)), unlimited);
  const R root = sqrt(max(e.t, real<R>(0)));
  e.half_height = root / v;
  e.tip = -w * root / (v * sqrt(w * w + v * v));
  return e;
}

// Largest x reached within dy in [lo, hi]; `side` +1 right, -1 left. It is concave in dy, so clamping the tip is exact.
template <class R>
DYNGS_HD R reach(const Ellipse<R>& e, R lo, R hi, R side) {
  const R dy = clamp(side * e.tip, lo, hi);
  const R inside = max(real<R>(0), e.t - e.v * e.v * dy * dy);
  return e.x + (side * sqrt(inside) - e.w * dy) / e.u;
}

// Integers (as reals) [begin, end).
template <class R>
struct PixelRange {
  R begin, end;
};

// The pixels whose centre lies in [lo, hi], clamped to the image. A slack of 1/1000 px covers the rounding of the bounds.
template <class R>
DYNGS_HD PixelRange<R> pixels_between(R lo, R hi, int size) {
  const R zero = real<R>(0), limit = real<R>(size), slack = real<R>(1e-3), half = real<R>(0.5), one = real<R>(1);
  const R first = clamp(lo - half - slack, zero, limit), last = clamp(hi + half + slack, zero, limit);
  const R down = trunc(first);
  return {down + select(first > down, one, zero), trunc(last)};
}

template <class R>
struct RowCover {
  PixelRange<R> columns;
  MaskOf<R> any;
};

// The pixel columns that the ellipse covers in the `rows` pixel rows from `top` on, in a image `width` px wide.
template <class R>
DYNGS_HD RowCover<R> columns_in_rows(const Ellipse<R>& e, R top, int rows, int width) {
  const R first = top + real<R>(0.5) - e.y;
  const R lo = max(first, -e.half_height), hi = min(first + real<R>(rows - 1), e.half_height);
  const PixelRange<R> range = pixels_between(reach(e, lo, hi, real<R>(-1)), reach(e, lo, hi, real<R>(1)), width);
  const MaskOf<R> any = (lo <= hi + real<R>(1e-3)) & (range.begin < range.end);
  return {range, any};
}

// Smallest u^2 + v^2 within boxes [x0, x1] x [y0, y1] relative to the centre. The quadratic form is convex: its minimum
// lies at the centre if that is inside, else on the facing vertical or horizontal edge; both are minimised in closed form.
template <class R, class S>
DYNGS_INLINE R least_in_box(S u, S w, S v, R x0, R y0, R x1, R y1) {
  const R zero = real<R>(0);
  const R edge_x = clamp(zero, x0, x1), edge_y = clamp(zero, y0, y1);
  const R y_on_edge = clamp(R(-u * w / (w * w + v * v)) * edge_x, y0, y1);
  const R x_on_edge = clamp(R(-w / u) * edge_y, x0, x1);
  const R u1 = R(u) * edge_x + R(w) * y_on_edge, v1 = R(v) * y_on_edge;
  const R u2 = R(u) * x_on_edge + R(w) * edge_y, v2 = R(v) * edge_y;
  return min(u1 * u1 + v1 * v1, u2 * u2 + v2 * v2);
}

}  // namespace dyngs

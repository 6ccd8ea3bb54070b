// The tile columns that an ellipse covers in each tile row, 16 Gaussians at a time.
#pragma once

#include <algorithm>

#include "cpu/kernels.hpp"
#include "math/packet.hpp"

namespace dyngs {

struct Span {
  int32_t begin, end;  // tile columns [begin, end)
};

struct Grid {
  int width, height, columns, rows;
};

// Where alpha reaches alpha_min: u^2 + v^2 <= t (see math/projection.hpp for u, v).
template <class S>
struct Ellipses {
  Packet<S> x, y, u, w, v, t;
  Packet<S> half_height;
  Packet<S> tip;  // dy of the rightmost point
};

// The ellipses of 16 rows of the splat arrays.
template <class S>
Ellipses<S> make_ellipses(const Splats<S>& s, const int32_t (&rows)[kLanes]) {
  using P = Packet<S>;
  Ellipses<S> e;
  P opacity;
  for (int i = 0; i < kLanes; ++i) {
    const int64_t row = rows[i];
    e.x[i] = s.means2d[2 * row], e.y[i] = s.means2d[2 * row + 1];
    e.u[i] = s.factors[3 * row], e.w[i] = s.factors[3 * row + 1], e.v[i] = s.factors[3 * row + 2];
    opacity[i] = s.opacities[row];
  }
  const P unlimited(S(1e30));  // alpha_min = 0: no pixel is negligible; finite, so that no NaN arises
  e.t = min_of(P(S(2)) * log_of(opacity / P(s.alpha_min)), unlimited);
  const P root = sqrt_of(max_of(e.t, P(S(0))));
  e.half_height = root / e.v;
  e.tip = -e.w * root / (e.v * sqrt_of(e.w * e.w + e.v * e.v));
  return e;
}

// Integers (as reals) first, last + 1 of the pixels whose centre lies in [lo, hi], clamped to the image. A slack of 1/1000
// px covers the rounding of the bounds.
template <class S>
struct PixelRange {
  Packet<S> begin, end;
};

template <class S>
PixelRange<S> pixels_between(Packet<S> lo, Packet<S> hi, int size) {
  using P = Packet<S>;
  const P zero(S(0)), limit(static_cast<S>(size)), slack(S(1e-3)), half(S(0.5)), one(S(1));
  const P first = min_of(max_of(lo - half - slack, zero), limit), last = min_of(max_of(hi + half + slack, zero), limit);
  const P down = truncated(first);
  return {down + select(first > down, one, zero), truncated(last)};
}

// Largest x reached within dy in [lo, hi]; `side` +1 right, -1 left. It is concave in dy, so clamping the tip is exact.
template <class S>
Packet<S> reach(const Ellipses<S>& e, Packet<S> lo, Packet<S> hi, Packet<S> side) {
  using P = Packet<S>;
  const P dy = min_of(max_of(side * e.tip, lo), hi);
  const P inside = max_of(P(S(0)), e.t - e.v * e.v * dy * dy);
  return e.x + (side * sqrt_of(inside) - e.w * dy) / e.u;
}

// Tile rows [begin, end) of every ellipse; empty where the opacity is below alpha_min.
template <class S>
void tile_rows(const Ellipses<S>& e, const Grid& grid, int32_t (&begin)[kLanes], int32_t (&end)[kLanes]) {
  const PixelRange<S> range = pixels_between(e.y - e.half_height, e.y + e.half_height, grid.height);
  for (int i = 0; i < kLanes; ++i) {
    const auto first = static_cast<int32_t>(range.begin[i]), last = static_cast<int32_t>(range.end[i]);
    const bool empty = !(e.t[i] > S(0)) || first >= last;
    begin[i] = empty ? 0 : first / kTile;
    end[i] = empty ? 0 : (last + kTile - 1) / kTile;
  }
}

// Tile columns within one tile row each (lane i: tile_row[i]).
template <class S>
void row_spans(const Ellipses<S>& e, Packet<S> tile_row, const Grid& grid, Span (&spans)[kLanes]) {
  using P = Packet<S>;
  const P top = tile_row * P(S(kTile)) + P(S(0.5)) - e.y;
  const P lo = max_of(top, -e.half_height), hi = min_of(top + P(S(kTile - 1)), e.half_height);
  const PixelRange<S> range = pixels_between(reach(e, lo, hi, P(S(-1))), reach(e, lo, hi, P(S(1))), grid.width);
  const Mask<S> hit = (lo <= hi + P(S(1e-3))) & (range.begin < range.end);
  const uint32_t bits = to_bits(hit);
  for (int i = 0; i < kLanes; ++i) {
    const auto first = static_cast<int32_t>(range.begin[i]), last = static_cast<int32_t>(range.end[i]);
    spans[i] = bits >> i & 1 ? Span{first / kTile, (last + kTile - 1) / kTile} : Span{0, 0};
  }
}

}  // namespace dyngs

// The tile columns that an ellipse covers in each tile row, 16 Gaussians at a time.
#pragma once

#include <algorithm>

#include "core/api.hpp"
#include "cpu/simd.hpp"
#include "math/ellipse.hpp"

namespace dyngs {

struct Span {
  int32_t begin, end;  // tile columns [begin, end)
};

struct Grid {
  int width, height, columns, rows;
};

// The ellipses of 16 rows of the splat arrays.
template <class S>
Ellipse<Packet<S>> load_ellipses(const Splats<S>& s, const int32_t (&rows)[kLanes]) {
  Packet<S> x, y, u, w, v, opacity;
  for (int i = 0; i < kLanes; ++i) {
    const int64_t row = rows[i];
    x[i] = s.means2d[2 * row], y[i] = s.means2d[2 * row + 1];
    u[i] = s.factors[3 * row], w[i] = s.factors[3 * row + 1], v[i] = s.factors[3 * row + 2];
    opacity[i] = s.opacities[row];
  }
  return visible_ellipse(x, y, u, w, v, opacity, s.alpha_min);
}

// Tile rows [begin, end) of every ellipse; empty where the opacity is below alpha_min.
template <class S>
void tile_rows(const Ellipse<Packet<S>>& e, const Grid& grid, int32_t (&begin)[kLanes], int32_t (&end)[kLanes]) {
  const PixelRange<Packet<S>> range = pixels_between(e.y - e.half_height, e.y + e.half_height, grid.height);
  for (int i = 0; i < kLanes; ++i) {
    const auto first = static_cast<int32_t>(range.begin[i]), last = static_cast<int32_t>(range.end[i]);
    const bool empty = !(e.t[i] > S(0)) || first >= last;
    begin[i] = empty ? 0 : first / kTile;
    end[i] = empty ? 0 : (last + kTile - 1) / kTile;
  }
}

// Tile columns within one tile row each (lane i: tile_row[i]).
template <class S>
void row_spans(const Ellipse<Packet<S>>& e, Packet<S> tile_row, const Grid& grid, Span (&spans)[kLanes]) {
  const RowCover<Packet<S>> cover = columns_in_rows(e, tile_row * Packet<S>(S(kTile)), kTile, grid.width);
  const PixelRange<Packet<S>>& range = cover.columns;
  const uint32_t bits = to_bits(cover.any);
  for (int i = 0; i < kLanes; ++i) {
    const auto first = static_cast<int32_t>(range.begin[i]), last = static_cast<int32_t>(range.end[i]);
    spans[i] = bits >> i & 1 ? Span{first / kTile, (last + kTile - 1) / kTile} : Span{0, 0};
  }
}

}  // namespace dyngs

// Which Gaussian meets which 16x16 tile, front to back. Exact: a tile is listed only if some pixel row of it is crossed
// by the ellipse where alpha >= alpha_min. One span of tile columns per Gaussian and tile row is computed once; counting
// and emitting both read the spans, so they cannot disagree.
#include <bit>
#include <cmath>
#include <stdexcept>
#include <string>
#include <utility>

#include "cpu/kernels.hpp"
#include "cpu/parallel.hpp"

namespace dyngs {
namespace {

constexpr int64_t kBlock = 2048;  // Gaussians per work item
constexpr int kRadixBits = 11, kBuckets = 1 << kRadixBits;

struct Span {
  int32_t begin, end;  // tile columns [begin, end)
};

struct Rows {
  int32_t begin, end;  // tile rows [begin, end)
};

struct Grid {
  int width, height, columns, rows;
};

template <class S>
int32_t clamp_to(S x, int32_t hi) {
  return x > S(0) ? (x < static_cast<S>(hi) ? static_cast<int32_t>(x) : hi) : 0;
}

// Pixels whose centre lies in [lo, hi], as tile indices; a slack of 1/1000 px covers rounding of the bounds.
template <class S>
Span tiles_between(S lo, S hi, int size, int tiles) {
  const S slack = S(1e-3);
  const int32_t first = clamp_to(std::ceil(lo - S(0.5) - slack), size);
  const int32_t last = clamp_to(std::floor(hi + S(0.5) + slack), size);  // one past the last pixel
  if (!(first < last)) return {0, 0};
  return {first / kTile, std::min(tiles, (last + kTile - 1) / kTile)};
}

// The ellipse u^2 + v^2 <= t of one Gaussian (see math/projection.hpp for u, v).
template <class S>
struct Ellipse {
  S x, y, u, w, v, t, half_height, tip;  // tip: dy of the rightmost point
};

template <class S>
Ellipse<S> make_ellipse(const Splats<S>& s, int64_t row) {
  Ellipse<S> e;
  e.x = s.means2d[2 * row], e.y = s.means2d[2 * row + 1];
  e.u = s.factors[3 * row], e.w = s.factors[3 * row + 1], e.v = s.factors[3 * row + 2];
  e.t = S(2) * std::log(s.opacities[row] / s.alpha_min);
  const S root = std::sqrt(e.t);
  e.half_height = root / e.v;
  e.tip = -e.w * root / (e.v * std::hypot(e.w, e.v));
  return e;
}

// Largest x reached within rows dy in [lo, hi]; `side` +1 right, -1 left. Concave in dy, so clamping the tip is exact.
template <class S>
S reach(const Ellipse<S>& e, S lo, S hi, S side) {
  const S dy = std::min(std::max(side * e.tip, lo), hi);
  const S inside = std::max(S(0), e.t - e.v * e.v * dy * dy);
  return e.x + (side * std::sqrt(inside) - e.w * dy) / e.u;
}

template <class S>
Span row_span(const Ellipse<S>& e, int tile_row, const Grid& grid) {
  const S lo = std::max(static_cast<S>(tile_row * kTile) + S(0.5) - e.y, -e.half_height);
  const S hi = std::min(static_cast<S>(tile_row * kTile + kTile) - S(0.5) - e.y, e.half_height);
  const S slack = S(1e-3);
  if (!(lo <= hi + slack)) return {0, 0};
  if (!std::isfinite(e.t)) return {0, grid.columns};  // alpha_min = 0: no pixel is negligible
  return tiles_between(reach(e, lo, hi, S(-1)), reach(e, lo, hi, S(1)), grid.width, grid.columns);
}

template <class S>
Rows tile_rows(const Splats<S>& s, int64_t row, const Grid& grid) {
  if (s.radii[2 * row] <= 0 || !(s.opacities[row] > s.alpha_min)) return {0, 0};
  const S y = s.means2d[2 * row + 1], r = static_cast<S>(s.radii[2 * row + 1]);
  const Span span = tiles_between(y - r, y + r, grid.height, grid.rows);
  return {span.begin, span.end};
}

struct Spans {
  std::vector<int64_t> offsets;  // (V N + 1) into spans
  std::vector<int32_t> first_row;
  std::vector<Span> spans;
};

int64_t prefix_sum(std::vector<int64_t>& counts) {
  int64_t total = 0;
  for (auto& c : counts) total += std::exchange(c, total);
  return total;
}

template <class S>
Spans find_spans(const Splats<S>& s, const Grid& grid, std::vector<int64_t>& tile_counts) {
  const int64_t total = s.num_views * s.num_gaussians;
  Spans out;
  out.offsets.assign(total + 1, 0);
  out.first_row.resize(total);
  parallel_for(total, kBlock, s.threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const Rows rows = tile_rows(s, i, grid);
      out.first_row[i] = rows.begin;
      out.offsets[i] = rows.end - rows.begin;
    }
  });
  out.spans.resize(prefix_sum(out.offsets));
  parallel_for(total, kBlock, s.threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const int64_t rows = out.offsets[i + 1] - out.offsets[i];
      if (rows == 0) continue;
      const Ellipse<S> e = make_ellipse(s, i);
      for (int64_t r = 0; r < rows; ++r) {
        const Span span = row_span(e, static_cast<int>(out.first_row[i] + r), grid);
        out.spans[out.offsets[i] + r] = span;
        tile_counts[i] += span.end - span.begin;
      }
    }
  });
  return out;
}

template <class S>
struct DepthKey;
template <>
struct DepthKey<float> {
  using Bits = uint32_t;
};
template <>
struct DepthKey<double> {
  using Bits = uint64_t;
};

// Indices of the visible Gaussians of one view, nearest first, ties by index: a stable radix sort on the bits of the
// (positive) depth.
template <class S>
std::vector<int32_t> sort_by_depth(const Splats<S>& s, int64_t first, const std::vector<int64_t>& slot_offsets) {
  using Bits = typename DepthKey<S>::Bits;
  struct Item {
    Bits key;
    int32_t index;
  };
  std::vector<Item> items, other;
  for (int64_t i = 0; i < s.num_gaussians; ++i)
    if (slot_offsets[first + i + 1] > slot_offsets[first + i])
      items.push_back({std::bit_cast<Bits>(s.depths[first + i]), static_cast<int32_t>(i)});
  other.resize(items.size());
  const int64_t n = static_cast<int64_t>(items.size());
  const int parts = n > 1 << 14 ? s.threads : 1;
  std::vector<int64_t> histogram(static_cast<size_t>(parts) * kBuckets);
  for (int shift = 0; shift < static_cast<int>(8 * sizeof(Bits)); shift += kRadixBits) {
    std::fill(histogram.begin(), histogram.end(), 0);
    parallel_parts(n, parts, [&](int part, int64_t begin, int64_t end) {
      int64_t* h = histogram.data() + static_cast<size_t>(part) * kBuckets;
      for (int64_t i = begin; i < end; ++i) ++h[(items[i].key >> shift) & (kBuckets - 1)];
    });
    int64_t sum = 0;
    for (int b = 0; b < kBuckets; ++b)
      for (int p = 0; p < parts; ++p) sum += std::exchange(histogram[static_cast<size_t>(p) * kBuckets + b], sum);
    parallel_parts(n, parts, [&](int part, int64_t begin, int64_t end) {
      int64_t* h = histogram.data() + static_cast<size_t>(part) * kBuckets;
      for (int64_t i = begin; i < end; ++i) other[h[(items[i].key >> shift) & (kBuckets - 1)]++] = items[i];
    });
    items.swap(other);
  }
  std::vector<int32_t> order(items.size());
  for (int64_t i = 0; i < n; ++i) order[i] = items[i].index;
  return order;
}

// Visits every (tile, slot) of the Gaussian at `row`, in slot order.
template <class F>
void for_each_tile(const Spans& spans, const Grid& grid, int64_t row, int64_t slot, F&& f) {
  for (int64_t r = spans.offsets[row]; r < spans.offsets[row + 1]; ++r) {
    const int64_t tile_row = spans.first_row[row] + (r - spans.offsets[row]);
    for (int32_t c = spans.spans[r].begin; c < spans.spans[r].end; ++c) f(tile_row * grid.columns + c, slot++);
  }
}

// Appends the Gaussians in depth order to their tiles' lists: a counting sort by tile, parallel over depth ranges.
void fill_view(const Spans& spans, const Grid& grid, int64_t first, const std::vector<int32_t>& order, int threads,
               int64_t first_tile, Binning& out) {
  const int64_t tiles = int64_t{grid.columns} * grid.rows, n = static_cast<int64_t>(order.size());
  const int parts = n > 1 << 12 ? threads : 1;
  std::vector<int64_t> cursor(static_cast<size_t>(parts) * tiles, 0);
  parallel_parts(n, parts, [&](int part, int64_t begin, int64_t end) {
    int64_t* c = cursor.data() + part * tiles;
    for (int64_t i = begin; i < end; ++i)
      for_each_tile(spans, grid, first + order[i], 0, [&](int64_t tile, int64_t) { ++c[tile]; });
  });
  int64_t sum = out.tile_offsets[first_tile];
  for (int64_t t = 0; t < tiles; ++t) {
    out.tile_offsets[first_tile + t] = sum;
    for (int p = 0; p < parts; ++p) sum += std::exchange(cursor[p * tiles + t], sum);
  }
  out.tile_offsets[first_tile + tiles] = sum;
  parallel_parts(n, parts, [&](int part, int64_t begin, int64_t end) {
    int64_t* c = cursor.data() + part * tiles;
    for (int64_t i = begin; i < end; ++i) {
      const int64_t row = first + order[i];
      for_each_tile(spans, grid, row, out.slot_offsets[row], [&](int64_t tile, int64_t slot) {
        const int64_t place = c[tile]++;
        out.gaussians[place] = static_cast<int32_t>(row);
        out.slots[place] = static_cast<int32_t>(slot);
      });
    }
  });
}

}  // namespace

template <class S>
Binning bin_tiles(const Splats<S>& s, int64_t max_entries) {
  const Grid grid{s.width, s.height, (s.width + kTile - 1) / kTile, (s.height + kTile - 1) / kTile};
  Binning out;
  out.slot_offsets.assign(s.num_views * s.num_gaussians + 1, 0);
  const Spans spans = find_spans(s, grid, out.slot_offsets);
  const int64_t total = prefix_sum(out.slot_offsets);
  if (total > max_entries)
    throw std::length_error(std::to_string(s.num_gaussians) + " Gaussians in " + std::to_string(s.num_views) +
                            " view(s) of " + std::to_string(s.width) + "x" + std::to_string(s.height) + " px meet " +
                            std::to_string(total) + " tiles, more than the limit of " + std::to_string(max_entries));
  out.gaussians.resize(total);
  out.slots.resize(total);
  const int64_t tiles = int64_t{grid.columns} * grid.rows;
  out.tile_offsets.assign(s.num_views * tiles + 1, 0);
  for (int64_t v = 0; v < s.num_views; ++v) {
    const int64_t first = v * s.num_gaussians;
    fill_view(spans, grid, first, sort_by_depth(s, first, out.slot_offsets), s.threads, v * tiles, out);
  }
  return out;
}

template Binning bin_tiles<float>(const Splats<float>&, int64_t);
template Binning bin_tiles<double>(const Splats<double>&, int64_t);

}  // namespace dyngs

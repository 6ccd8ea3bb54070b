// Lists the Gaussians of each 16x16 tile, front to back. Exact: a tile is listed only if the ellipse where
// alpha >= alpha_min crosses some pixel row of it. The visible Gaussians are sorted by depth first; all later passes run in
// that order. The span of tile columns of each Gaussian and tile row is computed once; counting and emitting both read the
// spans, so they cannot disagree.
//
// There may be more entries than memory holds, or than can be counted in a day. So all threads add theirs to one Budget, and
// once it is exceeded they only go on counting, for the message, and not for long.
#include <atomic>
#include <bit>
#include <limits>
#include <mutex>
#include <stdexcept>
#include <string>
#include <utility>

#include "core/api.hpp"
#include "cpu/memory.hpp"
#include "cpu/parallel.hpp"
#include "cpu/spans.hpp"

namespace dyngs {
namespace {

constexpr int kRadixBits = 11, kBuckets = 1 << kRadixBits;
// Below these sizes starting threads costs more than they save.
constexpr int64_t kParallelSort = 1 << 18, kParallelSpans = 1 << 11;

constexpr int64_t kBytesPerEntry = 20;     // of lists and spans, at most
constexpr int64_t kFewEntries = 1 << 22;   // up to here the free memory is not looked up
constexpr int64_t kCountedRows = 1 << 22;  // rows of spans that are still counted once there are too many entries

// The number of entries so far, and how many there may be.
class Budget {
 public:
  explicit Budget(int64_t max_entries) : limit_(std::min<int64_t>(max_entries, std::numeric_limits<int32_t>::max())) {}

  // Adds entries; returns whether the total is still within the budget.
  bool add(int64_t entries) {
    const int64_t total = total_.fetch_add(entries, std::memory_order_relaxed) + entries;
    if (total <= kFewEntries) return total <= limit_;
    std::call_once(asked_, [this] {
      available_ = available_memory();
      in_memory_ = std::max(available_ / kBytesPerEntry, kFewEntries);
    });
    return total <= std::min(limit_, in_memory_);
  }

  // These may be called once all threads are done.
  int64_t total() const { return total_; }
  bool exceeded() const { return total_ > std::min(limit_, in_memory_); }

  // The words that follow the number of entries in a message.
  std::string reason() const {
    if (total_ > limit_) return ", more than the limit of " + std::to_string(limit_);
    return ", whose lists take " + gigabytes(kBytesPerEntry * total_) + "; " + gigabytes(available_) +
           " of memory are available";
  }

 private:
  const int64_t limit_;
  std::atomic<int64_t> total_{0};
  std::once_flag asked_;
  int64_t available_ = 0, in_memory_ = std::numeric_limits<int64_t>::max();
};

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

// Rows (view * N + index) of the visible Gaussians of one view, nearest first, ties by index: a stable radix sort on the
// bits of the (positive) depth.
template <class S>
std::vector<int32_t> sort_by_depth(const Splats<S>& s, int64_t first) {
  using Bits = typename DepthKey<S>::Bits;
  struct Item {
    Bits key;
    int32_t row;
  };
  std::vector<Item> items, other;
  items.reserve(s.num_gaussians);
  for (int64_t row = first; row < first + s.num_gaussians; ++row)
    if (s.radii[2 * row] > 0) items.push_back({std::bit_cast<Bits>(s.depths[row]), static_cast<int32_t>(row)});
  other.resize(items.size());
  const int64_t n = static_cast<int64_t>(items.size());
  const int parts = n > kParallelSort ? s.threads : 1;
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
  for (int64_t i = 0; i < n; ++i) order[i] = items[i].row;
  return order;
}

// The spans of one contiguous part of a view's depth order, and how many entries they make per tile.
struct Part {
  struct Splat {
    int32_t row, first_row, num_rows;
  };
  std::vector<Splat> splats;
  std::vector<Span> spans;
  std::vector<int64_t> per_tile;  // counts, then the positions at which this part writes next
  int64_t entries = 0;
  bool within_budget = true;  // the total of all parts; if not, nothing more is stored
  int64_t counted_rows = 0;   // since then
};

template <class S>
void prefetch_splat(const Splats<S>& s, int64_t row) {
  __builtin_prefetch(s.means2d + 2 * row);
  __builtin_prefetch(s.factors + 3 * row);
  __builtin_prefetch(s.opacities + row);
}

// Stores and counts the spans of 16 splats, each in its tile row r.
void note_spans(const Span (&spans)[kLanes], const int32_t (&begin)[kLanes], const int32_t (&end)[kLanes], int32_t r,
                const Grid& grid, const size_t (&place)[kLanes], Part& part) {
  for (int i = 0; i < kLanes; ++i) {
    if (begin[i] + r >= end[i]) continue;
    part.entries += spans[i].end - spans[i].begin;
    if (!part.within_budget) continue;
    part.spans[place[i] + r] = spans[i];
    int64_t* tiles = part.per_tile.data() + int64_t{begin[i] + r} * grid.columns;
    for (int32_t c = spans[i].begin; c < spans[i].end; ++c) ++tiles[c];
  }
}

// Appends up to 16 splats to the part, each with its rows' spans.
template <class S>
void append_spans(const Splats<S>& s, const Grid& grid, const int32_t* order, int count, Part& part) {
  int32_t rows[kLanes], begin[kLanes], end[kLanes];
  for (int i = 0; i < kLanes; ++i) rows[i] = order[std::min(i, count - 1)];
  const Ellipse<Packet<S>> ellipses = load_ellipses(s, rows);
  tile_rows(ellipses, grid, begin, end);
  size_t place[kLanes], total = part.spans.size();
  int32_t most = 0;
  for (int i = 0; i < count; ++i) {
    place[i] = total;
    total += end[i] - begin[i];
    most = std::max(most, end[i] - begin[i]);
    if (begin[i] < end[i] && part.within_budget) part.splats.push_back({rows[i], begin[i], end[i] - begin[i]});
  }
  for (int i = count; i < kLanes; ++i) begin[i] = end[i] = 0;
  if (part.within_budget) {
    part.spans.resize(total);
  } else {
    part.counted_rows += most;
  }
  for (int32_t r = 0; r < most; ++r) {
    Packet<S> tile_row;
    for (int i = 0; i < kLanes; ++i) tile_row[i] = static_cast<S>(begin[i] + r);
    Span spans[kLanes];
    row_spans(ellipses, tile_row, grid, spans);
    note_spans(spans, begin, end, r, grid, place, part);
  }
}

// Finds the spans of `count` splats of the depth order.
template <class S>
void find_spans(const Splats<S>& s, const Grid& grid, const int32_t* order, int64_t count, Budget& budget, Part& part) {
  for (int64_t k = 0; k < count && part.counted_rows < kCountedRows; k += kLanes) {
    for (int64_t ahead = k + kLanes; ahead < std::min(count, k + 2 * kLanes); ++ahead)
      prefetch_splat(s, order[ahead]);  // depth order jumps through memory
    const int64_t before = part.entries;
    append_spans(s, grid, order + k, static_cast<int>(std::min<int64_t>(kLanes, count - k)), part);
    const bool within = budget.add(part.entries - before);
    if (part.within_budget && !within) std::vector<Span>().swap(part.spans);
    part.within_budget &= within;
  }
}

// Turns the counts of the parts into the positions at which each writes in each tile's list: parts in depth order.
void assign_places(std::vector<Part>& parts, int64_t* tile_offsets, int64_t start) {
  const size_t tiles = parts[0].per_tile.size();
  for (size_t t = 0; t < tiles; ++t) {
    tile_offsets[t] = start;
    for (Part& part : parts) start += std::exchange(part.per_tile[t], start);
  }
  tile_offsets[tiles] = start;
}

void emit(Part& part, const Grid& grid, int64_t slot, Binning& out) {
  const Span* span = part.spans.data();
  for (const Part::Splat& splat : part.splats) {
    out.slot_ranges[2 * int64_t{splat.row}] = static_cast<int32_t>(slot);
    for (int32_t r = splat.first_row; r < splat.first_row + splat.num_rows; ++r, ++span)
      for (int32_t c = span->begin; c < span->end; ++c) {
        const int64_t place = part.per_tile[int64_t{r} * grid.columns + c]++;
        out.gaussians[place] = splat.row;
        out.slots[place] = static_cast<int32_t>(slot++);
      }
    out.slot_ranges[2 * int64_t{splat.row} + 1] = static_cast<int32_t>(slot);
  }
}

template <class S>
std::vector<Part> bin_view(const Splats<S>& s, const Grid& grid, int64_t view, Budget& budget) {
  const std::vector<int32_t> order = sort_by_depth(s, view * s.num_gaussians);
  const int64_t n = static_cast<int64_t>(order.size());
  std::vector<Part> parts(n > kParallelSpans ? s.threads : 1);
  for (Part& part : parts) {
    const int64_t count = n / static_cast<int64_t>(parts.size()) + 1;
    part.splats.reserve(count);
    part.spans.reserve(2 * count);
    part.per_tile.assign(int64_t{grid.columns} * grid.rows, 0);
  }
  parallel_parts(n, static_cast<int>(parts.size()), [&](int p, int64_t begin, int64_t end) {
    find_spans(s, grid, order.data() + begin, end - begin, budget, parts[p]);
  });
  return parts;
}

std::string number_of(int64_t gaussians, int64_t views, const Grid& grid) {
  return std::to_string(gaussians) + " Gaussians in " + std::to_string(views) + " view(s) of " +
         std::to_string(grid.width) + "x" + std::to_string(grid.height) + " px";
}

// Throws if the arrays over tiles, one of offsets and one of counts per thread, do not fit into memory.
template <class S>
void check_tiles(const Splats<S>& s, const Grid& grid) {
  const double bytes = 8.0 * s.num_views * grid.columns * grid.rows * (s.threads + 1);
  if (bytes <= kFewEntries * kBytesPerEntry) return;
  const int64_t available = available_memory();
  if (bytes <= static_cast<double>(available)) return;
  throw std::length_error(number_of(s.num_gaussians, s.num_views, grid) + " have tiles whose lists take " +
                          gigabytes(static_cast<int64_t>(std::min(bytes, 9e18))) + "; " + gigabytes(available) +
                          " of memory are available");
}

}  // namespace

template <class S>
Binning bin_tiles(const Splats<S>& s, int64_t max_entries) {
  const Grid grid{s.width, s.height, (s.width + kTile - 1) / kTile, (s.height + kTile - 1) / kTile};
  const int64_t tiles = int64_t{grid.columns} * grid.rows;
  if (s.num_views * s.num_gaussians > std::numeric_limits<int32_t>::max())  // rows are int32
    throw std::length_error(std::to_string(s.num_gaussians) + " Gaussians in " + std::to_string(s.num_views) +
                            " views are more than 2^31 - 1 splats");
  check_tiles(s, grid);
  std::vector<std::vector<Part>> views;
  Budget budget(max_entries);
  bool counted = true;
  for (int64_t v = 0; v < s.num_views && counted; ++v) {
    views.push_back(bin_view(s, grid, v, budget));
    for (const Part& part : views.back()) counted &= part.counted_rows < kCountedRows;
  }
  if (budget.exceeded())
    throw std::length_error(number_of(s.num_gaussians, s.num_views, grid) + " meet " + (counted ? "" : "at least ") +
                            std::to_string(budget.total()) + " tiles" + budget.reason());
  const int64_t total = budget.total();
  Binning out;
  out.gaussians.resize(total);
  out.slots.resize(total);
  out.slot_ranges.assign(2 * s.num_views * s.num_gaussians, 0);
  out.tile_offsets.assign(s.num_views * tiles + 1, 0);
  int64_t slot = 0;
  for (int64_t v = 0; v < s.num_views; ++v) {
    std::vector<Part>& parts = views[v];
    assign_places(parts, out.tile_offsets.data() + v * tiles, slot);
    std::vector<int64_t> first_slots;
    first_slots.reserve(parts.size());
    for (const Part& part : parts) first_slots.push_back(std::exchange(slot, slot + part.entries));
    const int count = static_cast<int>(parts.size());
    parallel_parts(count, count, [&](int p, int64_t, int64_t) { emit(parts[p], grid, first_slots[p], out); });
  }
  return out;
}

template Binning bin_tiles<float>(const Splats<float>&, int64_t);
template Binning bin_tiles<double>(const Splats<double>&, int64_t);

}  // namespace dyngs

// Look-up in a multiresolution hash grid. A level's table does not fit the first caches, so one level after the other is read,
// by all threads. The backward pass gives each task the rows of one level, or a range of them, which it alone writes, sample by
// sample in order: no atomics, the same sums on any number of threads.
#include <algorithm>
#include <cstring>

#include "core/fields.hpp"
#include "cpu/parallel.hpp"

namespace dyngs {
namespace {

constexpr int kChunk = 16;  // samples
constexpr int64_t kGrain = 128 * kChunk;

// Up to kChunk samples, axis by axis.
template <int kDims, class S>
int load_coords(const HashGrid<S>& grid, int64_t begin, int64_t end, S (*coords)[kChunk]) {
  const int count = static_cast<int>(std::min<int64_t>(kChunk, end - begin));
  for (int i = 0; i < kChunk; ++i)
    for (int a = 0; a < kDims; ++a) coords[a][i] = i < count ? grid.coords[(begin + i) * kDims + a] : S(0);
  return count;
}

template <int kDims, int kFeatures, class S>
void level_forward(const HashGrid<S>& grid, const HashLevel& level, const S* table, int64_t begin, int64_t end,
                   S* features) {
  using Corners = HashCorners<kDims, kChunk, S>;
  const int64_t width = grid.width();
  const S* rows = table + level.first * kFeatures;
  S coords[kDims][kChunk];
  Corners corners;
  for (int64_t from = begin; from < end; from += kChunk) {
    const int count = load_coords<kDims>(grid, from, end, coords);
    locate_hashed<kDims, kChunk, S>(level, coords, corners);
    for (int i = 0; i < count; ++i) {
      S sum[kFeatures] = {};
      for (int c = 0; c < Corners::kCorners; ++c) {
        const S* row = rows + int64_t{corners.rows[c][i]} * kFeatures;
        const S weight = corners.weights[c][i];
        for (int f = 0; f < kFeatures; ++f) sum[f] += weight * row[f];
      }
      std::memcpy(features + (from + i) * width, sum, sizeof sum);
    }
  }
}

// Adds to the rows [first, last) of the level.
template <int kDims, int kFeatures, class S>
void level_backward(const HashGrid<S>& grid, const HashLevel& level, const S* g_features, int64_t first, int64_t last,
                    S* g_rows) {
  using Corners = HashCorners<kDims, kChunk, S>;
  const int64_t width = grid.width();
  const bool all = first == 0 && last == level.rows;
  std::fill(g_rows + first * kFeatures, g_rows + last * kFeatures, S(0));
  S coords[kDims][kChunk];
  Corners corners;
  for (int64_t from = 0; from < grid.count; from += kChunk) {
    const int count = load_coords<kDims>(grid, from, grid.count, coords);
    locate_hashed<kDims, kChunk, S>(level, coords, corners);
    for (int i = 0; i < count; ++i) {
      S grad[kFeatures];
      std::memcpy(grad, g_features + (from + i) * width, sizeof grad);
      for (int c = 0; c < Corners::kCorners; ++c) {
        const int64_t row = corners.rows[c][i];
        if (!all && (row < first || row >= last)) continue;
        S* to = g_rows + row * kFeatures;
        const S weight = corners.weights[c][i];
        for (int f = 0; f < kFeatures; ++f) to[f] += weight * grad[f];
      }
    }
  }
}

}  // namespace

template <class S>
void hash_grid_forward(const HashGrid<S>& grid, const S* table, S* features) {
  const int64_t blocks = (grid.count + kGrain - 1) / kGrain;
  with_grid_sizes(grid.dims, grid.features, [&]<int kDims, int kFeatures>() {
    parallel_for(blocks * static_cast<int64_t>(grid.levels.size()), 1, grid.threads, [&](int64_t task, int64_t) {
      const int64_t l = task / blocks, begin = task % blocks * kGrain;
      level_forward<kDims, kFeatures>(grid, grid.levels[l], table, begin, std::min(grid.count, begin + kGrain),
                                      features + l * kFeatures);
    });
  });
}

template <class S>
void hash_grid_backward(const HashGrid<S>& grid, const S* g_features, S* g_table) {
  const int64_t levels = static_cast<int64_t>(grid.levels.size()), parts = (grid.threads + levels - 1) / levels;
  with_grid_sizes(grid.dims, grid.features, [&]<int kDims, int kFeatures>() {
    parallel_for(levels * parts, 1, grid.threads, [&](int64_t task, int64_t) {
      const int64_t l = levels - 1 - task / parts, part = task % parts;  // the large ones first
      const HashLevel& level = grid.levels[l];
      level_backward<kDims, kFeatures>(grid, level, g_features + l * kFeatures, level.rows * part / parts,
                                       level.rows * (part + 1) / parts, g_table + level.first * kFeatures);
    });
  });
}

#define DYNGS_INSTANTIATE(S)                                            \
  template void hash_grid_forward<S>(const HashGrid<S>&, const S*, S*); \
  template void hash_grid_backward<S>(const HashGrid<S>&, const S*, S*);
DYNGS_INSTANTIATE(float)
DYNGS_INSTANTIATE(double)
#undef DYNGS_INSTANTIATE

}  // namespace dyngs

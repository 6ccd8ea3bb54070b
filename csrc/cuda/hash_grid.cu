// Look-up in a multiresolution hash grid (math/hash_grid.hpp), level by level, so that one table at a time is in the second-level
// cache; one thread per sample. Backward, each sample writes the rows of its 2^D corners; these pairs are sorted by row, stably,
// and lanes of a warp, or of all warps of a block where many pairs come to a row, add up what a row gets: no atomics, the same
// bytes every time. Samples are taken some at a time, so that the workspace stays small.
//
// Limits, H100 (3.35 TB/s, L2 cache about 5.5 TB/s), D = 3, F = 4, one level. Forward, per sample: 28 bytes of its own and 8
// rows, each a sector of 32 bytes of the L2 cache: 8 ps and 47 ps. Backward: 8 pairs, of which 12 bytes are written, three passes
// of the sort at 20, and read again with their gradients, 12 + 32 from the L2 cache: 0.6 KB, 0.17 ns, and 0.35 KB, 64 ps. A row
// with most of many pairs is one block's work, or, where the others of its level have few, one warp's.
#include <algorithm>

#include "cuda/api.hpp"
#include "cuda/reduce.hpp"
#include "cuda/sort.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 256, kWarps = kThreads / kWarpSize;
constexpr int64_t kCrowded = 2 * kWarpSize;  // pairs per row of a level, from which a row gets all warps of a block

template <int kDims>
__device__ void locate_sample(const HashLevel& level, const float* coords, int64_t m,
                              HashCorners<kDims, 1, float>& out) {
  float at[kDims][1];
  DYNGS_UNROLL
  for (int a = 0; a < kDims; ++a) at[a][0] = global(coords)[m * kDims + a];
  locate_hashed<kDims, 1, float>(level, at, out);
}

// `rows`, `features`: from the level's first row and first feature on.
template <int kDims, int kFeatures>
__global__ void __launch_bounds__(kThreads) hash_features_kernel(HashLevel level, const float* coords, int64_t count,
                                                                 const float* rows, int64_t width, float* features) {
  const int64_t m = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (m >= count) return;
  HashCorners<kDims, 1, float> corners;
  locate_sample<kDims>(level, coords, m, corners);
  float sum[kFeatures] = {};
  DYNGS_UNROLL
  for (int c = 0; c < corners.kCorners; ++c) {
    const Array<const float> row = global(rows) + int64_t{corners.rows[c][0]} * kFeatures;
    DYNGS_UNROLL
    for (int f = 0; f < kFeatures; ++f) sum[f] += corners.weights[c][0] * row[f];
  }
  DYNGS_UNROLL
  for (int f = 0; f < kFeatures; ++f) global(features)[m * width + f] = sum[f];
}

// A pair is corner i % 2^D of sample i / 2^D; its key is the row.
template <int kDims>
__global__ void __launch_bounds__(kThreads)
    hash_pairs_kernel(HashLevel level, const float* coords, int64_t count, Pairs pairs, float* weights) {
  const int64_t m = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (m >= count) return;
  HashCorners<kDims, 1, float> corners;
  locate_sample<kDims>(level, coords, m, corners);
  DYNGS_UNROLL
  for (int c = 0; c < corners.kCorners; ++c) {
    const int64_t i = m * corners.kCorners + c;
    global(pairs.keys)[i] = corners.rows[c][0];
    global(pairs.values)[i] = static_cast<int32_t>(i);
    global(weights)[i] = corners.weights[c][0];
  }
}

// Pairs by row, the place of each row's first one, and their weights before they were sorted.
struct SortedPairs {
  const int32_t *pairs, *offsets;
  const float* weights;
};

// `parts` warps for each row, whose sums are added in their order. `gradients`: of the level's features of the first sample on,
// rows of `width`; a sample has 2^dims pairs.
template <int kFeatures>
__global__ void __launch_bounds__(kThreads)
    gather_rows_kernel(SortedPairs sorted, const float* gradients, int64_t width, int dims, int64_t rows, int parts,
                       bool is_first, float* g_rows) {
  DYNGS_SHARED(float, sums, kWarps* kFeatures);
  const int lane = static_cast<int>(threadIdx.x) % kWarpSize, warp = static_cast<int>(threadIdx.x) / kWarpSize;
  const int64_t row = int64_t{blockIdx.x} * (kWarps / parts) + warp / parts;
  const int64_t begin = row < rows ? int64_t{global(sorted.offsets)[row]} : 0;
  const int64_t end = row < rows ? int64_t{global(sorted.offsets)[row + 1]} : 0;
  float sum[kFeatures] = {};
  for (int64_t k = begin + warp % parts * kWarpSize + lane; k < end; k += int64_t{parts} * kWarpSize) {
    const int64_t pair = global(sorted.pairs)[k];
    const float weight = global(sorted.weights)[pair];
    const Array<const float> from = global(gradients) + (pair >> dims) * width;
    DYNGS_UNROLL
    for (int f = 0; f < kFeatures; ++f) sum[f] += weight * from[f];
  }
  DYNGS_UNROLL
  for (int f = 0; f < kFeatures; ++f) {
    const float total = warp_sum(sum[f]);
    if (lane == 0) sums[warp * kFeatures + f] = total;
  }
  __syncthreads();
  if (row >= rows || warp % parts != 0 || lane >= kFeatures) return;
  float total = 0.f;
  for (int p = 0; p < parts; ++p) total += sums[(warp + p) * kFeatures + lane];
  const int64_t to = row * kFeatures + lane;
  global(g_rows)[to] = is_first ? total : static_cast<float>(global(g_rows)[to]) + total;
}

struct BackwardBuffers {
  int64_t at_once;  // samples
  Pairs pairs, other;
  float* weights;
  int32_t* offsets;
  SortScratch sort;
  BackwardBuffers(Workspace& w, const HashGrid<float>& grid, int64_t most)
      : at_once(std::min(grid.count, std::max<int64_t>(most, 1))),
        pairs{w.take<uint32_t>(at_once << grid.dims), w.take<int32_t>(at_once << grid.dims)},
        other{w.take<uint32_t>(at_once << grid.dims), w.take<int32_t>(at_once << grid.dims)},
        weights(w.take<float>(at_once << grid.dims)),
        offsets(w.take<int32_t>(most_rows(grid) + 1)),
        sort(w, at_once << grid.dims) {}

  static int64_t most_rows(const HashGrid<float>& grid) {
    int64_t most = 0;
    for (const HashLevel& level : grid.levels) most = std::max(most, level.rows);
    return most;
  }
};

// Writes, or adds, what `count` samples give to the rows of a level; `coords`, `gradients`, `g_rows`: from the first of each on.
template <int kDims, int kFeatures>
void gather_level(const HashLevel& level, const float* coords, int64_t count, const float* gradients, int64_t width,
                  bool is_first, float* g_rows, const BackwardBuffers& b, Stream stream) {
  const int64_t pairs = count << kDims;
  launch("hash_pairs", {blocks_for(count, kThreads), kThreads}, stream, hash_pairs_kernel<kDims>, level, coords, count,
         b.pairs, b.weights);
  const Pairs& sorted = stable_sort(b.pairs, b.other, pairs, bits_for(level.rows), b.sort, stream);
  find_offsets(sorted.keys, pairs, level.rows, b.offsets, stream);
  const int parts = pairs >= kCrowded * level.rows ? kWarps : 1;
  launch("gather_rows", {blocks_for(level.rows, kWarps / parts), kThreads}, stream, gather_rows_kernel<kFeatures>,
         SortedPairs{sorted.values, b.offsets, b.weights}, gradients, width, kDims, level.rows, parts, is_first,
         g_rows);
}

}  // namespace

void hash_grid_forward(const HashGrid<float>& grid, const float* table, float* features, Stream stream) {
  with_grid_sizes(grid.dims, grid.features, [&]<int kDims, int kFeatures>() {
    for (size_t l = 0; l < grid.levels.size(); ++l) {
      const HashLevel& level = grid.levels[l];
      launch("hash_features", {blocks_for(grid.count, kThreads), kThreads}, stream,
             hash_features_kernel<kDims, kFeatures>, level, grid.coords, grid.count, table + level.first * kFeatures,
             grid.width(), features + static_cast<int64_t>(l) * kFeatures);
    }
  });
}

int64_t hash_grid_backward_workspace(const HashGrid<float>& grid, int64_t at_once) {
  Workspace w(nullptr, 0);
  const BackwardBuffers buffers(w, grid, at_once);
  return w.taken();
}

void hash_grid_backward(const HashGrid<float>& grid, const float* g_features, float* g_table, const Lent& lent,
                        Stream stream, int64_t at_once) {
  Workspace workspace(lent.memory, lent.bytes);
  const BackwardBuffers b(workspace, grid, at_once);
  const int64_t width = grid.width();
  with_grid_sizes(grid.dims, grid.features, [&]<int kDims, int kFeatures>() {
    for (size_t l = 0; l < grid.levels.size(); ++l) {
      int64_t first = 0;
      do {  // also of no samples: the gradients are 0 then
        const int64_t count = std::min(b.at_once, grid.count - first);
        gather_level<kDims, kFeatures>(grid.levels[l], grid.coords + first * kDims, count,
                                       g_features + first * width + static_cast<int64_t>(l) * kFeatures, width,
                                       first == 0, g_table + grid.levels[l].first * kFeatures, b, stream);
        first += count;
      } while (first < grid.count);
    }
  });
}

}  // namespace dyngs::cuda

// Lists the Gaussians of each 16x16 tile, front to back, as cpu/bin_tiles.cpp does: a tile is listed only if the ellipse where
// alpha >= alpha_min crosses some pixel row of it (math/ellipse.hpp). All splats of all views are sorted by depth once; the
// entries are emitted in that order, so that those of a Gaussian are contiguous (its slots), and a stable partition by
// (view, tile) keeps the order of depth within each tile.
//
// Counting and emitting compute the same spans and must agree to the last one. So this file is compiled without contraction
// into fused multiply-adds: every operation is rounded by itself, whatever code surrounds it.
//
// A splat in few tile rows is its thread's work, one in more rows that of the whole warp.
//
// Limits, H100 (3.35 TB/s, 67 TFLOP/s). Per splat 72 bytes for two walks and about 60 operations per tile row: bound by memory,
// 22 ps; per entry 8 bytes emitted, 8 + 4 + 4 gathered at the end, beside the partition (sort.cu): 7 ps and 12. The entry
// count is read back once, because the caller allocates the lists.
#include <limits>

#include "cuda/api.hpp"
#include "cuda/reduce.hpp"
#include "cuda/sort.hpp"
#include "math/ellipse.hpp"

#if defined(__CUDACC__) && !defined(DYNGS_NO_FMAD)
#error "compile this file with -fmad=false -DDYNGS_NO_FMAD: see above"
#endif

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 128;
constexpr int kFewRows = 6;                    // tile rows of a splat that one thread walks alone
constexpr uint32_t kNeverDrawn = 0xffffffffu;  // behind every depth

struct TileGrid {
  int width, height, columns, rows;
  explicit TileGrid(const Splats<float>& s)
      : width(s.width),
        height(s.height),
        columns((s.width + kTile - 1) / kTile),
        rows((s.height + kTile - 1) / kTile) {}
  int64_t tiles() const { return int64_t{columns} * rows; }
};

__global__ void __launch_bounds__(kThreads) depth_keys_kernel(Splats<float> s, Pairs out) {
  const int64_t row = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (row >= s.num_views * s.num_gaussians) return;
  const float depth = global(s.depths)[row];  // positive where drawn: its bits sort as the number does
  global(out.keys)[row] = global(s.radii)[2 * row] > 0 ? float_bits(depth) : kNeverDrawn;
  global(out.values)[row] = static_cast<int32_t>(row);
}

__device__ Ellipse<float> load_ellipse(const Splats<float>& s, int64_t row) {
  const Array<const float> m = global(s.means2d) + 2 * row, f = global(s.factors) + 3 * row;
  return visible_ellipse(static_cast<float>(m[0]), static_cast<float>(m[1]), static_cast<float>(f[0]),
                         static_cast<float>(f[1]), static_cast<float>(f[2]),
                         static_cast<float>(global(s.opacities)[row]), s.alpha_min);
}

// [begin, end) of tile rows, or of the tile columns in one of them.
struct Range {
  int begin, end;
};

__device__ Range tiles_of(const PixelRange<float>& pixels, bool any) {
  const int first = static_cast<int>(pixels.begin), last = static_cast<int>(pixels.end);
  return any && first < last ? Range{first / kTile, (last + kTile - 1) / kTile} : Range{0, 0};
}
__device__ Range rows_of(const Ellipse<float>& e, const TileGrid& grid) {
  return tiles_of(pixels_between(e.y - e.half_height, e.y + e.half_height, grid.height), e.t > 0.f);
}
__device__ Range columns_of(const Ellipse<float>& e, int tile_row, const TileGrid& grid) {
  const RowCover<float> cover = columns_in_rows(e, static_cast<float>(tile_row * kTile), kTile, grid.width);
  return tiles_of(cover.columns, cover.any);
}

// The splat at place k of the depth order: its row in the arrays, its ellipse and tile rows; none where it is not drawn.
struct Listed {
  int64_t row;
  Ellipse<float> ellipse;
  Range rows;
};
__device__ Listed load_listed(const Splats<float>& s, const TileGrid& grid, const Pairs& order, int64_t k) {
  Listed listed{0, {}, {0, 0}};
  if (k >= s.num_views * s.num_gaussians || global(order.keys)[k] == kNeverDrawn) return listed;
  listed.row = global(order.values)[k];
  listed.ellipse = load_ellipse(s, listed.row);
  listed.rows = rows_of(listed.ellipse, grid);
  return listed;
}

__device__ bool is_few(const Range& rows) { return rows.end - rows.begin <= kFewRows; }

__global__ void __launch_bounds__(kThreads)
    count_tiles_kernel(Splats<float> s, TileGrid grid, Pairs order, int32_t* counts) {
  const int64_t k = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  const int lane = static_cast<int>(threadIdx.x) % kWarpSize;
  const Listed mine = load_listed(s, grid, order, k);
  int32_t count = 0;
  if (is_few(mine.rows))
    for (int r = mine.rows.begin; r < mine.rows.end; ++r) {
      const Range columns = columns_of(mine.ellipse, r, grid);
      count += columns.end - columns.begin;
    }
  for (uint32_t large = __ballot_sync(kAllLanes, !is_few(mine.rows)); large != 0; large &= large - 1) {
    const int owner = __ffs(static_cast<int>(large)) - 1;
    const Listed listed = load_listed(s, grid, order, k - lane + owner);
    int32_t part = 0;
    for (int r = listed.rows.begin + lane; r < listed.rows.end; r += kWarpSize) {
      const Range columns = columns_of(listed.ellipse, r, grid);
      part += columns.end - columns.begin;
    }
    const int32_t sum = warp_sum(part);
    if (lane == owner) count = sum;
  }
  if (k < s.num_views * s.num_gaussians) global(counts)[k] = count;
}

struct Emitted {
  uint32_t* tiles;  // (E,) which tile of all views
  int32_t* slots;   // (E,) 0, 1, 2, ...
  int32_t* rows;    // (E,) of which splat
};

// Writes the entries of one tile row from `slot` on; returns the slot after them.
__device__ int32_t emit_row(const Range& columns, int64_t first_tile, int64_t row, int32_t slot, const Emitted& out) {
  for (int c = columns.begin; c < columns.end; ++c, ++slot) {
    global(out.tiles)[slot] = static_cast<uint32_t>(first_tile + c);
    global(out.slots)[slot] = slot;
    global(out.rows)[slot] = static_cast<int32_t>(row);
  }
  return slot;
}

__global__ void __launch_bounds__(kThreads)
    emit_kernel(Splats<float> s, TileGrid grid, Pairs order, const int32_t* first_slots, int32_t num_entries,
                Emitted out, int32_t* slot_ranges) {
  const int64_t k = int64_t{blockIdx.x} * kThreads + threadIdx.x, splats = s.num_views * s.num_gaussians;
  const int lane = static_cast<int>(threadIdx.x) % kWarpSize;
  const Listed mine = load_listed(s, grid, order, k);
  if (is_few(mine.rows) && k < splats) {
    int32_t slot = global(first_slots)[k];
    const int64_t first_row = mine.row / s.num_gaussians * grid.rows;
    for (int r = mine.rows.begin; r < mine.rows.end; ++r)
      slot = emit_row(columns_of(mine.ellipse, r, grid), (first_row + r) * grid.columns, mine.row, slot, out);
  }
  for (uint32_t large = __ballot_sync(kAllLanes, !is_few(mine.rows)); large != 0; large &= large - 1) {
    const int owner = __ffs(static_cast<int>(large)) - 1;
    const Listed listed = load_listed(s, grid, order, k - lane + owner);
    const int64_t first_row = listed.row / s.num_gaussians * grid.rows;
    int32_t slot = global(first_slots)[k - lane + owner];
    for (int first = listed.rows.begin; first < listed.rows.end; first += kWarpSize) {
      const int r = first + lane;
      const Range columns = r < listed.rows.end ? columns_of(listed.ellipse, r, grid) : Range{0, 0};
      const int32_t width = columns.end - columns.begin;
      int32_t upto = width;  // entries of this lane's row and those above it
      for (int step = 1; step < kWarpSize; step *= 2) {
        const int32_t above = __shfl_up_sync(kAllLanes, upto, step);
        if (lane >= step) upto += above;
      }
      emit_row(columns, (first_row + r) * grid.columns, listed.row, slot + upto - width, out);
      slot += __shfl_sync(kAllLanes, upto, kWarpSize - 1);
    }
  }
  if (k >= splats) return;
  const int32_t begin = global(first_slots)[k];
  const int32_t end = k + 1 < splats ? static_cast<int32_t>(global(first_slots)[k + 1]) : num_entries;
  const int64_t row = global(order.values)[k];
  global(slot_ranges)[2 * row] = begin < end ? begin : 0;
  global(slot_ranges)[2 * row + 1] = begin < end ? end : 0;
}

// Entry i gets its splat, tile i the place of its first entry.
__global__ void __launch_bounds__(kThreads)
    finish_kernel(const uint32_t* tiles, const int32_t* rows, int64_t num_entries, int64_t num_tiles, EntryArrays out) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i < num_entries) global(out.gaussians)[i] = static_cast<int32_t>(global(rows)[global(out.slots)[i]]);
  if (i > num_tiles) return;
  global(out.tile_offsets)[i] = first_of(tiles, num_entries, i);
}

// Results of bin_count for bin_emit, and its scratch memory.
struct CountBuffers {
  Pairs order, other;
  int32_t* first_slots;
  SortScratch sort;
  ScanScratch scan;
  CountBuffers(Workspace&& w, int64_t splats)
      : order{w.take<uint32_t>(splats), w.take<int32_t>(splats)},
        other{w.take<uint32_t>(splats), w.take<int32_t>(splats)},
        first_slots(w.take<int32_t>(splats)),
        sort(w, splats),
        scan(w, splats),
        bytes(w.taken()) {}
  int64_t bytes;
};

struct EmitBuffers {
  uint32_t *tiles, *other_tiles;
  int32_t *other_slots, *rows;
  SortScratch sort;
  EmitBuffers(Workspace&& w, int64_t entries)
      : tiles(w.take<uint32_t>(entries)),
        other_tiles(w.take<uint32_t>(entries)),
        other_slots(w.take<int32_t>(entries)),
        rows(w.take<int32_t>(entries)),
        sort(w, entries),
        bytes(w.taken()) {}
  int64_t bytes;
};

void check_sizes(const Splats<float>& s, const TileGrid& grid) {
  constexpr int64_t kMost = std::numeric_limits<int32_t>::max();
  if (s.num_views * s.num_gaussians > kMost)
    throw std::length_error(std::to_string(s.num_gaussians) + " Gaussians in " + std::to_string(s.num_views) +
                            " views are more than 2^31 - 1 splats");
  if (s.num_views > 0 && grid.tiles() > kMost / s.num_views)
    throw std::length_error(std::to_string(s.num_views) + " view(s) of " + std::to_string(s.width) + "x" +
                            std::to_string(s.height) + " px have more than 2^31 - 1 tiles");
}

}  // namespace

int64_t bin_count_workspace(int64_t num_splats) { return CountBuffers(Workspace(nullptr, 0), num_splats).bytes; }

int64_t bin_count(const Splats<float>& s, int64_t max_entries, const Lent& workspace, Stream stream) {
  const TileGrid grid(s);
  check_sizes(s, grid);
  const int64_t splats = s.num_views * s.num_gaussians, blocks = blocks_for(splats, kThreads);
  if (splats == 0) return 0;
  const CountBuffers buffers(Workspace(workspace.memory, workspace.bytes), splats);
  launch("depth_keys", {blocks, kThreads}, stream, depth_keys_kernel, s, buffers.order);
  static_assert(32 / kRadixBits % 2 == 0, "the sorted pairs are those of `order` again");
  stable_sort(buffers.order, buffers.other, splats, 32, buffers.sort, stream);
  launch("count_tiles", {blocks, kThreads}, stream, count_tiles_kernel, s, grid, buffers.order, buffers.first_slots);
  exclusive_scan(buffers.first_slots, splats, buffers.scan, stream);
  int64_t total = 0;
  read_back(&total, buffers.scan.total, sizeof total, stream);
  const int64_t most = std::min<int64_t>(max_entries, std::numeric_limits<int32_t>::max());
  if (total > most)
    throw std::length_error(std::to_string(s.num_gaussians) + " Gaussians in " + std::to_string(s.num_views) +
                            " view(s) of " + std::to_string(s.width) + "x" + std::to_string(s.height) + " px meet " +
                            std::to_string(total) + " tiles, more than the limit of " + std::to_string(most));
  return total;
}

int64_t bin_emit_workspace(int64_t num_entries) { return EmitBuffers(Workspace(nullptr, 0), num_entries).bytes; }

void bin_emit(const Splats<float>& s, int64_t num_entries, const Lent& counted, const EntryArrays& out,
              const Lent& workspace, Stream stream) {
  const TileGrid grid(s);
  const int64_t splats = s.num_views * s.num_gaussians, tiles = s.num_views * grid.tiles();
  const EmitBuffers buffers(Workspace(workspace.memory, workspace.bytes), num_entries);
  // The passes end in out.slots.
  const int bits = bits_for(tiles);
  const bool even = passes_for(bits) % 2 == 0;
  const Pairs from{buffers.tiles, even ? out.slots : buffers.other_slots};
  const Pairs other{buffers.other_tiles, even ? buffers.other_slots : out.slots};
  if (splats > 0) {
    const CountBuffers of_count(Workspace(counted.memory, counted.bytes), splats);
    launch("emit", {blocks_for(splats, kThreads), kThreads}, stream, emit_kernel, s, grid, of_count.order,
           static_cast<const int32_t*>(of_count.first_slots), static_cast<int32_t>(num_entries),
           Emitted{from.keys, from.values, buffers.rows}, out.slot_ranges);
  }
  stable_sort(from, other, num_entries, bits, buffers.sort, stream);
  launch("finish", {blocks_for(std::max(num_entries, tiles + 1), kThreads), kThreads}, stream, finish_kernel,
         static_cast<const uint32_t*>(even ? from.keys : other.keys), static_cast<const int32_t*>(buffers.rows),
         num_entries, tiles, out);
}

}  // namespace dyngs::cuda

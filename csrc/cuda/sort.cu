// A radix sort from the lowest digit up (Knuth, vol. 3), eight bits per pass: count the digits of each piece of 2048 items, a
// prefix sum over (digit, piece), and a second walk in which every item finds its place from the lanes, warps and pieces
// before it. Items of a warp with the same digit find each other with __match_any_sync.
//
// Limits, H100 (3.35 TB/s). Bound by memory: a pass reads 4 + 8 bytes per item and writes 8, 6 ps; a depth sort of 1 M is
// four passes, 24 us; a partition of 10 M entries over up to 65536 tiles two, 120 us. The scattered writes fill sectors
// only as far as neighbours share a digit. A scan reads 8 bytes per item and writes 4.
#include "cuda/sort.hpp"

#include "cuda/reduce.hpp"
#include "math/scalar.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 256, kWarps = kThreads / kWarpSize;
constexpr int kRounds = 8;
constexpr int kPiece = kThreads * kRounds;  // items of a block
constexpr int kDigits = 1 << kRadixBits;
static_assert(kDigits == kThreads, "one thread per digit");

// Sum over the threads before this one; `total` receives that of all. `warp_sums`: shared, one place per warp.
__device__ int64_t scan_block(int64_t value, const Array<int64_t>& warp_sums, int64_t& total) {
  const int lane = static_cast<int>(threadIdx.x) % kWarpSize, warp = static_cast<int>(threadIdx.x) / kWarpSize;
  int64_t sum = value;
  for (int step = 1; step < kWarpSize; step *= 2) {
    const int64_t below = __shfl_up_sync(kAllLanes, sum, step);
    if (lane >= step) sum += below;
  }
  if (lane == kWarpSize - 1) warp_sums[warp] = sum;
  __syncthreads();
  int64_t before = 0;
  total = 0;
  for (int w = 0; w < kWarps; ++w) {
    const int64_t of_warp = warp_sums[w];
    if (w < warp) before += of_warp;
    total += of_warp;
  }
  __syncthreads();
  return before + sum - value;
}

__global__ void __launch_bounds__(kThreads) sum_pieces_kernel(const int32_t* counts, int64_t count, int64_t* partials) {
  DYNGS_SHARED(int64_t, warp_sums, kWarps);
  const int64_t first = int64_t{blockIdx.x} * kPiece;
  int64_t sum = 0;
  for (int r = 0; r < kRounds; ++r) {
    const int64_t i = first + r * kThreads + threadIdx.x;
    if (i < count) sum += global(counts)[i];
  }
  const int64_t total = block_sum(sum, warp_sums);
  if (threadIdx.x == 0) global(partials)[blockIdx.x] = total;
}

// One block: the partial sums become sums of all before them.
__global__ void __launch_bounds__(kThreads) scan_partials_kernel(int64_t* partials, int64_t count, int64_t* total) {
  DYNGS_SHARED(int64_t, warp_sums, kWarps);
  int64_t before = 0;
  for (int64_t first = 0; first < count; first += kThreads) {
    const int64_t i = first + threadIdx.x;
    const int64_t value = i < count ? static_cast<int64_t>(global(partials)[i]) : 0;
    int64_t of_all = 0;
    const int64_t sum = scan_block(value, warp_sums, of_all);
    if (i < count) global(partials)[i] = before + sum;
    before += of_all;
  }
  if (threadIdx.x == 0) global(total)[0] = before;
}

__global__ void __launch_bounds__(kThreads)
    scan_pieces_kernel(int32_t* counts, int64_t count, const int64_t* partials) {
  DYNGS_SHARED(int64_t, warp_sums, kWarps);
  int64_t before = global(partials)[blockIdx.x];
  for (int r = 0; r < kRounds; ++r) {
    const int64_t i = int64_t{blockIdx.x} * kPiece + r * kThreads + threadIdx.x;
    const int64_t value = i < count ? static_cast<int32_t>(global(counts)[i]) : 0;
    int64_t of_all = 0;
    const int64_t sum = scan_block(value, warp_sums, of_all);
    if (i < count) global(counts)[i] = static_cast<int32_t>(before + sum);
    before += of_all;
  }
}

__device__ int digit_of(uint32_t key, int shift) { return static_cast<int>(key >> shift) & (kDigits - 1); }

// histogram (kDigits, pieces).
__global__ void __launch_bounds__(kThreads)
    count_digits_kernel(const uint32_t* keys, int64_t count, int shift, int32_t* histogram) {
  DYNGS_SHARED(int32_t, counts, kDigits);
  counts[threadIdx.x] = 0;
  __syncthreads();
  for (int r = 0; r < kRounds; ++r) {
    const int64_t i = int64_t{blockIdx.x} * kPiece + r * kThreads + threadIdx.x;
    if (i < count) atomic_add(counts, digit_of(global(keys)[i], shift), 1);
  }
  __syncthreads();
  global(histogram)[int64_t{threadIdx.x} * gridDim.x + blockIdx.x] = static_cast<int32_t>(counts[threadIdx.x]);
}

// The number of equal digits before this item in its warp's part of the piece; `counters`: shared, those of the warp so far.
__device__ int rank_in_warp(int digit, bool exists, const Array<int32_t>& counters) {
  const int lane = static_cast<int>(threadIdx.x) % kWarpSize;
  const uint32_t equal = __match_any_sync(kAllLanes, exists ? digit : kDigits);
  const int before = exists ? static_cast<int32_t>(counters[digit]) : 0;
  __syncwarp();
  if (exists && lane == __ffs(static_cast<int>(equal)) - 1) counters[digit] = before + __popc(equal);
  __syncwarp();
  return before + __popc(equal & ((1u << lane) - 1));
}

__global__ void __launch_bounds__(kThreads)
    move_items_kernel(Pairs from, Pairs to, int64_t count, int shift, const int32_t* places) {
  DYNGS_SHARED(int32_t, counters, kWarps* kDigits);
  const int lane = static_cast<int>(threadIdx.x) % kWarpSize, warp = static_cast<int>(threadIdx.x) / kWarpSize;
  for (int w = 0; w < kWarps; ++w) counters[w * kDigits + threadIdx.x] = 0;
  __syncthreads();
  const Array<int32_t> of_warp = counters + warp * kDigits;
  const int64_t first = int64_t{blockIdx.x} * kPiece + warp * kRounds * kWarpSize + lane;
  uint32_t key[kRounds];
  int rank[kRounds];
  DYNGS_UNROLL
  for (int r = 0; r < kRounds; ++r) {
    const int64_t i = first + r * kWarpSize;
    const bool exists = i < count;
    key[r] = exists ? static_cast<uint32_t>(global(from.keys)[i]) : 0;
    rank[r] = rank_in_warp(digit_of(key[r], shift), exists, of_warp);
  }
  __syncthreads();
  int32_t place = global(places)[int64_t{threadIdx.x} * gridDim.x + blockIdx.x];  // of this thread's digit
  for (int w = 0; w < kWarps; ++w) {
    const int32_t in_warp = counters[w * kDigits + threadIdx.x];
    counters[w * kDigits + threadIdx.x] = place;
    place += in_warp;
  }
  __syncthreads();
  DYNGS_UNROLL
  for (int r = 0; r < kRounds; ++r) {
    const int64_t i = first + r * kWarpSize;
    if (i >= count) continue;
    const int64_t to_place = static_cast<int32_t>(of_warp[digit_of(key[r], shift)]) + rank[r];
    global(to.keys)[to_place] = key[r];
    global(to.values)[to_place] = static_cast<int32_t>(global(from.values)[i]);
  }
}

__global__ void __launch_bounds__(kThreads)
    find_offsets_kernel(const uint32_t* keys, int64_t count, int64_t num_keys, int32_t* offsets) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i <= num_keys) global(offsets)[i] = static_cast<int32_t>(first_of(keys, count, i));
}

}  // namespace

ScanScratch::ScanScratch(Workspace& workspace, int64_t count)
    : partials(workspace.take<int64_t>(blocks_for(count, kPiece))), total(workspace.take<int64_t>(1)) {}

void exclusive_scan(int32_t* counts, int64_t count, const ScanScratch& scratch, Stream stream) {
  const int64_t blocks = blocks_for(count, kPiece);
  launch("sum_pieces", {blocks, kThreads}, stream, sum_pieces_kernel, static_cast<const int32_t*>(counts), count,
         scratch.partials);
  launch("scan_partials", {1, kThreads}, stream, scan_partials_kernel, scratch.partials, blocks, scratch.total);
  launch("scan_pieces", {blocks, kThreads}, stream, scan_pieces_kernel, counts, count,
         static_cast<const int64_t*>(scratch.partials));
}

SortScratch::SortScratch(Workspace& workspace, int64_t count)
    : histogram(workspace.take<int32_t>(kDigits * blocks_for(count, kPiece))),
      scan(workspace, kDigits * blocks_for(count, kPiece)) {}

const Pairs& stable_sort(const Pairs& from, const Pairs& other, int64_t count, int bits, const SortScratch& scratch,
                         Stream stream) {
  const int64_t blocks = blocks_for(count, kPiece);
  for (int pass = 0; pass < passes_for(bits); ++pass) {
    const Pairs &source = pass % 2 == 0 ? from : other, &target = pass % 2 == 0 ? other : from;
    launch("count_digits", {blocks, kThreads}, stream, count_digits_kernel, static_cast<const uint32_t*>(source.keys),
           count, pass * kRadixBits, scratch.histogram);
    exclusive_scan(scratch.histogram, kDigits * blocks, scratch.scan, stream);
    launch("move_items", {blocks, kThreads}, stream, move_items_kernel, source, target, count, pass * kRadixBits,
           static_cast<const int32_t*>(scratch.histogram));
  }
  return passes_for(bits) % 2 == 0 ? from : other;
}

void find_offsets(const uint32_t* keys, int64_t count, int64_t num_keys, int32_t* offsets, Stream stream) {
  launch("find_offsets", {blocks_for(num_keys + 1, kThreads), kThreads}, stream, find_offsets_kernel, keys, count,
         num_keys, offsets);
}

}  // namespace dyngs::cuda

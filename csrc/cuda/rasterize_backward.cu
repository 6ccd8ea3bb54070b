// Backward pass of the blending, back to front (math/blend.hpp), without atomics: the same bytes every time. As on the CPU
// (cpu/rasterize_backward.cpp), the gradient of a Gaussian is linear in a few sums over pixels, so a pixel only hands over two
// numbers per Gaussian, p = dL/dlog alpha and the blending weight. Each warp keeps those of eight Gaussians for its 32 pixels
// in shared memory, then changes roles: four lanes share a Gaussian, each of them with one row of eight pixels, and two
// shuffles per sum finish it. The sums of a block's warps are added in their order and written to the entry's slot; a second
// kernel adds up the slots of each Gaussian.
//
// Moments are taken about the point of the tile nearest to the centre, sums about the point of the image nearest to it, and
// only the total is moved to the centre: cpu/rasterize_backward.cpp says why.
//
// Limits, H100 (3.35 TB/s, 67 TFLOP/s), F = 6 + D sums. Per pair of a Gaussian and a pixel about 45 + 4 D operations (forward
// again, the recursion, the sums), four accesses of shared memory and D of the first-level cache; per entry 28 + 4 D bytes read
// and 4 F written and read again, per pixel 8 D + 12. With D = 3 and 100 walked pairs per pixel: 5700 operations, 85 ps per pixel,
// against 36 bytes and 100 / 256 entries of 112 bytes, 24 ps: bound by arithmetic, 1 megapixel no faster than 85 us.
#include "cuda/api.hpp"
#include "cuda/reduce.hpp"
#include "cuda/tile.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kBatch = 8;            // Gaussians that a warp hands over at a time
constexpr int kRow = kWarpSize + 1;  // numbers per Gaussian of a batch: odd, so that its lanes meet in no bank
constexpr int kMostFields = 48;
static_assert(kBlendSums + kMaxChannels + 2 <= kMostFields);

// Entries of a chunk: at most 32, one per lane.
DYNGS_HD constexpr int chunk_of(int cap) { return cap <= 16 ? 32 : 16; }

// Numbers per slot: sums, D colours, then |d mean x|, |d mean y| if asked for.
struct Layout {
  int channels;
  bool absolute;
  DYNGS_HD int fields() const { return kBlendSums + channels + (absolute ? 2 : 0); }
};

// The state of a pixel between Gaussians.
template <int kCap>
struct PixelState {
  BlendBehind<float> behind;
  float grad[kCap];  // dL/dC
  int32_t stop;      // entries from here on were not drawn
};

template <int kCap>
__device__ PixelState<kCap> load_pixel(const Splats<float>& s, const ImageGrads<float>& image, const TilePlace& tile,
                                       const PixelPlace& pixel) {
  PixelState<kCap> state;
  state.behind = {1.f, 0.f}, state.stop = 0;
  DYNGS_UNROLL
  for (int c = 0; c < kCap; ++c) state.grad[c] = 0.f;
  if (!pixel.inside) return state;
  float light = global(image.transmittance)[pixel.index];
  DYNGS_UNROLL
  for (int c = 0; c < kCap; ++c) {
    if (c >= s.channels) continue;
    state.grad[c] = global(image.color)[pixel.index * s.channels + c];
    if (image.background != nullptr) light += global(image.background)[tile.view * s.channels + c] * state.grad[c];
  }
  state.behind = {global(image.final_transmittance)[pixel.index], light};
  state.stop = min(static_cast<int32_t>(global(image.stop)[pixel.index]), tile.count);
  return state;
}

// The point nearest to the centre in the square of the tile's pixel centres.
__device__ Vec2<float> nearest_in_tile(const TilePlace& tile, const BlendGaussian<float>& g) {
  const float x0 = static_cast<float>(tile.x0) + 0.5f, y0 = static_cast<float>(tile.y0) + 0.5f;
  return {clamp(g.x, x0, x0 + static_cast<float>(kTile - 1)), clamp(g.y, y0, y0 + static_cast<float>(kTile - 1))};
}
// The point nearest to (x, y) in the image.
__device__ Vec2<float> nearest_in_image(const Splats<float>& s, float x, float y) {
  return {clamp(x, 0.f, static_cast<float>(s.width)), clamp(y, 0.f, static_cast<float>(s.height))};
}

// The arrays of a warp in shared memory.
struct WarpArrays {
  Array<float> p, weight;  // (kBatch, kRow)
  Array<float> sums;       // (chunk, fields of the kernel)
};

// One pixel's step for one Gaussian: p and weight, into place `k` of the batch.
template <int kCap>
__device__ void step_pixel(const Splats<float>& s, const Array<const float>& color, float log2_raw, bool drawn, int k,
                           const WarpArrays& warp, PixelState<kCap>& state) {
  const float raw = exp2(log2_raw), alpha = clamped_alpha(raw, s.alpha_max, drawn);
  float shade = 0.f;
  DYNGS_UNROLL
  for (int c = 0; c < kCap; ++c) shade += color[c] * state.grad[c];
  const BlendGrad<float> grad = blend_vjp(raw, alpha, s.alpha_max, shade, state.behind);
  const int lane = static_cast<int>(threadIdx.x) % kWarpSize;
  warp.p[k * kRow + lane] = grad.by_log_alpha;
  warp.weight[k * kRow + lane] = grad.weight;
}

// Sums of |p d(log alpha)/d(mean)| over a row of pixels: absolute values do not factor into moments.
__device__ Vec2<float> absolute_slopes(const StagedGaussian& staged, const float (&p)[kBlockColumns], float x0,
                                       float y) {
  const BlendGaussian<float>& g = staged.gaussian;
  Vec2<float> sum{0.f, 0.f};
  for (int i = 0; i < kBlockColumns; ++i) {
    const Vec2<float> at = whitened(g.u, g.w, g.v, staged.first, x0 + static_cast<float>(i), y);
    const Vec2<float> slope = slope_by_mean(p[i], g.u, g.w, g.v, at);
    sum.x += abs(slope.x), sum.y += abs(slope.y);
  }
  const float unscale = 2.f / static_cast<float>(kLog2E);  // a BlendGaussian holds u, w, v times sqrt(log2(e) / 2)
  return {sum.x * unscale, sum.y * unscale};
}

// Sums over a row of pixels for one Gaussian of the batch. `out`: moments about the row's block's first pixel, colours, slopes.
template <int kCap, bool kAbsolute>
__device__ void sum_row(const Splats<float>& s, const ImageGrads<float>& image, const TilePlace& tile,
                        const PixelPlace& pixel, const StagedGaussian& staged, int k, const WarpArrays& warp,
                        float* out) {
  const int row = static_cast<int>(threadIdx.x) % kWarpSize / kBatch;  // of the warp's block of pixels
  const int first = k * kRow + row * kBlockColumns;
  float p[kBlockColumns], one = 0.f, x = 0.f, xx = 0.f;
  DYNGS_UNROLL
  for (int i = 0; i < kBlockColumns; ++i) {
    p[i] = warp.p[first + i];
    const float fx = static_cast<float>(i);
    one += p[i], x += fx * p[i], xx += fx * fx * p[i];
  }
  const float fy = static_cast<float>(row);
  out[kOne] = one, out[kX] = x, out[kY] = fy * one, out[kXX] = xx, out[kXY] = fy * x, out[kYY] = fy * fy * one;
  const int x0 = tile.x0 + pixel.block_x, y = tile.y0 + pixel.block_y + row;
  const int columns = y < s.height ? min(kBlockColumns, s.width - x0) : 0;  // inside the image
  const int64_t index = (int64_t{tile.view} * s.height + y) * s.width + x0;
  DYNGS_UNROLL
  for (int c = 0; c < kCap; ++c) out[kBlendSums + c] = 0.f;
  for (int i = 0; i < columns; ++i) {
    const float weight = warp.weight[first + i];
    DYNGS_UNROLL
    for (int c = 0; c < kCap; ++c)
      if (c < s.channels) out[kBlendSums + c] += weight * global(image.color)[(index + i) * s.channels + c];
  }
  if constexpr (kAbsolute) {
    const Vec2<float> slopes =
        absolute_slopes(staged, p, static_cast<float>(pixel.block_x), static_cast<float>(pixel.block_y + row));
    out[kBlendSums + kCap] = slopes.x, out[kBlendSums + kCap + 1] = slopes.y;
  }
}

// Turns the batch of `count` Gaussians into sums; `mine`: the entry, within the chunk, of Gaussian lane % kBatch.
template <int kCap, bool kAbsolute>
__device__ void finish_batch(const Splats<float>& s, const ImageGrads<float>& image, const TilePlace& tile,
                             const PixelPlace& pixel, const Array<const StagedGaussian>& staged, int count, int mine,
                             const WarpArrays& warp) {
  constexpr int kFields = kBlendSums + kCap + (kAbsolute ? 2 : 0);
  const int lane = static_cast<int>(threadIdx.x) % kWarpSize, k = lane % kBatch, row = lane / kBatch;
  __syncwarp();
  float field[kFields] = {};
  StagedGaussian g{};
  if (k < count) {
    g = staged[mine];
    sum_row<kCap, kAbsolute>(s, image, tile, pixel, g, k, warp, field);
  }
  DYNGS_UNROLL
  for (int f = 0; f < kFields; ++f) {
    field[f] += __shfl_xor_sync(kAllLanes, field[f], kBatch);
    field[f] += __shfl_xor_sync(kAllLanes, field[f], 2 * kBatch);
  }
  const Vec2<float> anchor = nearest_in_tile(tile, g.gaussian);
  const float moments[kBlendSums] = {field[0], field[1], field[2], field[3], field[4], field[5]};
  moments_about(moments, anchor.x - (static_cast<float>(tile.x0 + pixel.block_x) + 0.5f),
                anchor.y - (static_cast<float>(tile.y0 + pixel.block_y) + 0.5f), field);
  DYNGS_UNROLL
  for (int f = 0; f < kFields; ++f)  // the four lanes of a Gaussian write a quarter each
    if (k < count && f % (kWarpSize / kBatch) == row) warp.sums[mine * kFields + f] = field[f];
  __syncwarp();
}

// Turns the moments of one entry about its anchor in the tile into the sums of its slot.
__device__ void write_sums(const Splats<float>& s, const TilePlace& tile, const BlendGaussian<float>& g,
                           const float* moments, const Array<float>& slot) {
  const double unscale = 1 / sqrt(0.5 * kLog2E);  // a BlendGaussian holds u, w, v times sqrt(log2(e) / 2)
  const Vec2<float> anchor = nearest_in_tile(tile, g), near = nearest_in_image(s, g.x, g.y);
  const Vec2<double> far{double{g.x} - double{anchor.x}, double{g.y} - double{anchor.y}};
  const Vec2<double> origin{double{near.x} - double{anchor.x}, double{near.y} - double{anchor.y}};
  float sums[kBlendSums];
  blend_sums(moments, double{g.u} * unscale, double{g.w} * unscale, double{g.v} * unscale, far, origin, sums);
  for (int f = 0; f < kBlendSums; ++f) slot[f] = sums[f];
}

// Adds up the warps' sums of a chunk and writes the slots. `sums` (warps, kChunk, kFields).
template <int kCap, bool kAbsolute>
__device__ void store_chunk(const Splats<float>& s, const Entries& entries, const TilePlace& tile, int32_t at,
                            int count, const Array<const StagedGaussian>& staged, const Array<const float>& sums,
                            float* slots) {
  constexpr int kFields = kBlendSums + kCap + (kAbsolute ? 2 : 0), kOfWarp = chunk_of(kCap) * kFields;
  const Layout layout{s.channels, kAbsolute};
  const int thread = static_cast<int>(threadIdx.x), rest = layout.fields() - kBlendSums;
  const Array<const int32_t> slot_of = global(entries.slots) + (tile.begin + at);
  if (thread < count) {
    float moments[kBlendSums] = {};
    for (int w = 0; w < kTileWarps; ++w)
      for (int f = 0; f < kBlendSums; ++f) moments[f] += sums[w * kOfWarp + thread * kFields + f];
    const StagedGaussian g = staged[thread];
    write_sums(s, tile, g.gaussian, moments, global(slots) + int64_t{slot_of[thread]} * layout.fields());
  }
  for (int k = thread; k < count * rest; k += kTileThreads) {
    const int i = k / rest, f = k % rest;
    const int from = f < s.channels ? f : kCap + f - s.channels;
    float sum = 0.f;
    for (int w = 0; w < kTileWarps; ++w) sum += sums[w * kOfWarp + i * kFields + kBlendSums + from];
    global(slots)[int64_t{slot_of[i]} * layout.fields() + kBlendSums + f] = sum;
  }
}

// Walks the warp's pixels back to front through the chunk, and leaves sums for each of its entries.
template <int kCap, bool kAbsolute>
__device__ void walk_chunk(const Splats<float>& s, const ImageGrads<float>& image, const TilePlace& tile,
                           const PixelPlace& pixel, int32_t at, int count, const Array<const StagedGaussian>& staged,
                           const Array<const float>& colors, const WarpArrays& warp, PixelState<kCap>& state) {
  constexpr int kFields = kBlendSums + kCap + (kAbsolute ? 2 : 0);
  const int lane = static_cast<int>(threadIdx.x) % kWarpSize;
  const float log2_alpha_min = log2(s.alpha_min);
  const bool hit = lane < count && touches_block(staged[lane], tile, pixel, log2_alpha_min);
  uint32_t hits = __ballot_sync(kAllLanes, hit), summed = 0;
  int batched = 0, mine = 0;
  while (hits != 0) {
    const int i = kWarpSize - 1 - __clz(static_cast<int>(hits));
    hits &= ~(1u << i);
    const StagedGaussian g = staged[i];
    const float x = log2_alpha_in_tile(g, static_cast<float>(pixel.x), static_cast<float>(pixel.y));
    const bool drawn = x >= log2_alpha_min && at + i < state.stop;
    if (__any_sync(kAllLanes, drawn) == 0) continue;
    step_pixel(s, colors + i * kCap, x, drawn, batched, warp, state);
    if (lane % kBatch == batched) mine = i;
    summed |= 1u << i;
    if (++batched < kBatch) continue;
    finish_batch<kCap, kAbsolute>(s, image, tile, pixel, staged, batched, mine, warp);
    batched = 0;
  }
  if (batched > 0) finish_batch<kCap, kAbsolute>(s, image, tile, pixel, staged, batched, mine, warp);
  if (lane < count && (summed >> lane & 1) == 0)
    for (int f = 0; f < kFields; ++f) warp.sums[lane * kFields + f] = 0.f;
}

template <int kCap, bool kAbsolute>
__global__ void __launch_bounds__(kTileThreads)
    blend_backward_kernel(Splats<float> s, Entries entries, ImageGrads<float> image, float* slots) {
  constexpr int kChunk = chunk_of(kCap), kFields = kBlendSums + kCap + (kAbsolute ? 2 : 0);
  DYNGS_SHARED(StagedGaussian, staged, kChunk);
  DYNGS_SHARED(float, colors, kChunk* kCap);
  DYNGS_SHARED(float, batches, kTileWarps * 2 * kBatch * kRow);
  DYNGS_SHARED(float, sums, kTileWarps * kChunk * kFields);
  DYNGS_SHARED(int32_t, stops, kTileWarps);
  const int thread = static_cast<int>(threadIdx.x), warp = thread / kWarpSize;
  const TilePlace tile = place_tile(s, entries);
  const PixelPlace pixel = place_pixel(s, tile);
  PixelState<kCap> state = load_pixel<kCap>(s, image, tile, pixel);
  const int32_t stop_of_warp = warp_max(state.stop);
  if (thread % kWarpSize == 0) stops[warp] = stop_of_warp;
  __syncthreads();
  int32_t last = 0;  // entries from here on were drawn nowhere in the tile
  for (int w = 0; w < kTileWarps; ++w) last = max(last, static_cast<int32_t>(stops[w]));

  const int fields = Layout{s.channels, kAbsolute}.fields();
  for (int64_t k = thread; k < int64_t{tile.count - last} * fields; k += kTileThreads) {
    const int64_t slot = global(entries.slots)[tile.begin + last + k / fields];
    global(slots)[slot * fields + k % fields] = 0.f;
  }
  const Array<float> p = batches + warp * 2 * kBatch * kRow;
  const WarpArrays arrays{p, p + kBatch * kRow, sums + warp * kChunk * kFields};
  for (int32_t at = (last - 1) / kChunk * kChunk; at >= 0 && at < last; at -= kChunk) {
    const int count = min(kChunk, last - at);
    stage_entries<kCap>(s, entries, tile, at, count, staged, colors);
    __syncthreads();
    walk_chunk<kCap, kAbsolute>(s, image, tile, pixel, at, count, staged, colors, arrays, state);
    __syncthreads();
    store_chunk<kCap, kAbsolute>(s, entries, tile, at, count, staged, sums,
                                 slots);  // of `staged` a thread reads there only what it writes next
  }
}

__device__ void write_gaussian(const Splats<float>& s, int64_t row, const double* sum, const SplatGrads<float>& out) {
  const Array<const float> m = global(s.means2d) + 2 * row, f = global(s.factors) + 3 * row;
  const float x = m[0], y = m[1], u = f[0], w = f[1], v = f[2], opacity = global(s.opacities)[row];
  const Vec2<float> near = nearest_in_image(s, x, y);
  const BlendSplatGrad<float> grad =
      splat_grad<float>(sum, u, w, v, opacity, {double{x} - double{near.x}, double{y} - double{near.y}});
  global(out.means2d)[2 * row] = grad.mean.x, global(out.means2d)[2 * row + 1] = grad.mean.y;
  global(out.factors)[3 * row] = grad.u, global(out.factors)[3 * row + 1] = grad.w,
                          global(out.factors)[3 * row + 2] = grad.v;
  global(out.opacities)[row] = grad.opacity;
  if (out.probe == nullptr) return;
  global(out.probe)[4 * row] = grad.mean.x, global(out.probe)[4 * row + 1] = grad.mean.y;
  if (!out.absolute) global(out.probe)[4 * row + 2] = 0.f, global(out.probe)[4 * row + 3] = 0.f;
}

// Adds up the slots of each splat in double, one thread per number, so that neighbours read neighbours.
__global__ void __launch_bounds__(kTileThreads)
    sum_slots_kernel(Splats<float> s, Entries entries, const float* slots, SplatGrads<float> out) {
  DYNGS_SHARED(double, totals, kTileThreads);
  const Layout layout{s.channels, out.absolute};
  const int fields = layout.fields(), of_block = kTileThreads / fields, thread = static_cast<int>(threadIdx.x);
  const int64_t first = int64_t{blockIdx.x} * of_block, splats = s.num_views * s.num_gaussians;
  const int64_t row = first + thread / fields;
  const int f = thread % fields;
  if (thread < of_block * fields && row < splats) {
    double sum = 0;
    for (int64_t k = global(entries.slot_ranges)[2 * row]; k < global(entries.slot_ranges)[2 * row + 1]; ++k)
      sum += global(slots)[k * fields + f];
    totals[thread] = sum;
    const int c = f - kBlendSums;
    if (c >= s.channels) {
      if (out.probe != nullptr) global(out.probe)[4 * row + 2 + c - s.channels] = static_cast<float>(sum);
    } else if (c >= 0) {
      global(out.colors)[row * s.channels + c] = static_cast<float>(sum);
    }
  }
  __syncthreads();
  if (thread >= of_block || first + thread >= splats) return;
  double sum[kBlendSums];
  for (int k = 0; k < kBlendSums; ++k) sum[k] = totals[thread * fields + k];
  write_gaussian(s, first + thread, sum, out);
}

}  // namespace

int64_t rasterize_backward_workspace(int64_t num_entries, int channels, bool absolute) {
  return num_entries * Layout{channels, absolute}.fields() * int64_t{sizeof(float)};
}

void rasterize_backward(const Splats<float>& s, const Entries& entries, const ImageGrads<float>& image,
                        const SplatGrads<float>& out, const Lent& workspace, Stream stream) {
  const int fields = Layout{s.channels, out.absolute}.fields();
  auto* slots = Workspace(workspace.memory, workspace.bytes).take<float>(entries.count * fields);
  with_channels(s.channels, [&](auto cap) {
    constexpr int kCap = decltype(cap)::value;
    launch("blend_backward", {s.tiles(), kTileThreads}, stream,
           out.absolute ? blend_backward_kernel<kCap, true> : blend_backward_kernel<kCap, false>, s, entries, image,
           slots);
  });
  launch("sum_slots", {blocks_for(s.num_views * s.num_gaussians, kTileThreads / fields), kTileThreads}, stream,
         sum_slots_kernel, s, entries, static_cast<const float*>(slots), out);
}

}  // namespace dyngs::cuda

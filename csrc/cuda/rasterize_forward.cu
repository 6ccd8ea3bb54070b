// Front-to-back blending (math/blend.hpp), one thread per pixel; cuda/tile.hpp says how the work is shared out.
//
// Limits, H100 (3.35 TB/s, 67 TFLOP/s), D channels. Per (Gaussian, pixel) pair that a warp walks through about 20 + 2 D operations;
// per entry 28 + 4 D bytes, per pixel 8 + 4 D. With D = 3 and 100 walked pairs per pixel: 2600 operations, 39 ps per pixel,
// against 20 bytes and 100 / 256 entries of 40 bytes, 11 ps: bound by arithmetic, and in practice by how it is issued (one
// exponential and three reads of shared memory per pair). 1 megapixel no faster than 39 us.
#include <limits>

#include "cuda/api.hpp"
#include "cuda/reduce.hpp"
#include "cuda/tile.hpp"

namespace dyngs::cuda {
namespace {

constexpr int32_t kNeverFull = 0x7fffffff;

// Entries copied at a time: at most 12 KiB of colours.
DYNGS_HD constexpr int chunk_of(int cap) { return cap <= 8 ? 256 : cap <= 16 ? 128 : 64; }

template <int kCap>
struct PixelState {
  float transmittance = 1.f, behind = 0.f;  // `behind`: kSquaredSlopes, the light of all channels from here on
  float color[kCap] = {};
  int32_t stop = kNeverFull;
  bool open;
};

// The contribution of a Gaussian to the tally at one pixel. `step` is already zero for saturated pixels.
template <int kCap, Tally kTally>
__device__ float tally_of(const Splats<float>& s, float log2_opacity, float alpha, float before,
                          const BlendStep<float>& step, const Array<const float>& color, PixelState<kCap>& state) {
  if constexpr (kTally == Tally::kWeights) return step.weight;
  if constexpr (kTally == Tally::kPixels) return step.weight > 0.f ? 1.f : 0.f;
  if constexpr (kTally == Tally::kSquaredSlopes) {
    float shade = 0.f;
    for (int c = 0; c < kCap; ++c) shade += color[c];
    const float own = step.weight * shade;
    const float slope = exp2(log2_opacity) * slope_by_alpha(alpha, before, shade, own, state.behind);
    state.behind -= own;
    return !step.full && alpha < s.alpha_max ? slope * slope : 0.f;  // the clamp stops the gradient
  }
  return 0.f;
}

// Blends one Gaussian into one pixel; returns what it adds to the tally.
template <int kCap, Tally kTally>
__device__ float blend_pixel(const Splats<float>& s, const StagedGaussian& staged, const Array<const float>& color,
                             const PixelPlace& pixel, float log2_alpha_min, int32_t position, PixelState<kCap>& state) {
  const float x = log2_alpha_in_tile(staged, static_cast<float>(pixel.x), static_cast<float>(pixel.y));
  if (!(x >= log2_alpha_min)) return 0.f;
  const float alpha = clamped_alpha(exp2(x), s.alpha_max, true), before = state.transmittance;
  BlendStep<float> step = blend_step(alpha, before, s.transmittance_min);
  if (step.full) {
    leave_full(before, step);
    state.open = false, state.stop = position;
  }
  state.transmittance = step.transmittance;
  DYNGS_UNROLL
  for (int c = 0; c < kCap; ++c) state.color[c] += step.weight * color[c];
  return tally_of<kCap, kTally>(s, staged.gaussian.log2_opacity, alpha, before, step, color, state);
}

template <int kCap>
__device__ void write_pixel(const Splats<float>& s, const Image<float>& image, const TilePlace& tile,
                            const PixelPlace& pixel, const PixelState<kCap>& state) {
  global(image.transmittance)[pixel.index] = state.transmittance;
  global(image.stop)[pixel.index] = state.stop;
  const Array<float> to = global(image.color) + pixel.index * s.channels;
  const Array<const float> background = global(image.background) + int64_t{tile.view} * s.channels;
  DYNGS_UNROLL
  for (int c = 0; c < kCap; ++c) {
    if (c >= s.channels) continue;
    const float behind = image.background != nullptr ? static_cast<float>(background[c]) : 0.f;
    to[c] = state.color[c] + state.transmittance * behind;
  }
}

// `slot_sums` (E): the tally per entry. Every warp adds up its own pixels; the sums of the warps are added in their order.
template <int kCap, Tally kTally>
__global__ void __launch_bounds__(kTileThreads, kCap <= 4 ? 4 : 2)
    blend_kernel(Splats<float> s, Entries entries, Image<float> image, float* slot_sums) {
  constexpr int kChunk = chunk_of(kCap);
  constexpr bool kTallied = kTally != Tally::kNone;
  DYNGS_SHARED(StagedGaussian, staged, kChunk);
  DYNGS_SHARED(float, colors, kChunk* kCap);
  DYNGS_SHARED(float, sums, kTallied ? kChunk * kTileWarps : 1);
  const TilePlace tile = place_tile(s, entries);
  const PixelPlace pixel = place_pixel(s, tile);
  const int thread = static_cast<int>(threadIdx.x), lane = thread % kWarpSize, warp = thread / kWarpSize;
  const float log2_alpha_min = log2(s.alpha_min);
  PixelState<kCap> state;
  state.open = pixel.inside;
  if constexpr (kTally == Tally::kSquaredSlopes)
    for (int c = 0; c < s.channels && pixel.inside; ++c)
      state.behind += global(image.color)[pixel.index * s.channels + c];

  int32_t at = 0;
  for (; at < tile.count; at += kChunk) {
    if (__syncthreads_and(!state.open)) break;  // and nobody reads the last chunk any more
    const int count = min(kChunk, tile.count - at);
    stage_entries<kCap>(s, entries, tile, at, count, staged, colors);
    __syncthreads();
    for (int first = 0; first < count; first += kWarpSize) {
      const int mine = first + lane;
      const bool any_open = __any_sync(kAllLanes, state.open) != 0;
      const bool hit = any_open && mine < count && touches_block(staged[mine], tile, pixel, log2_alpha_min);
      if (kTallied && mine < count && !hit) sums[warp * kChunk + mine] = 0.f;
      for (uint32_t hits = __ballot_sync(kAllLanes, hit); hits != 0; hits &= hits - 1) {
        const int i = first + __ffs(static_cast<int>(hits)) - 1;
        float tallied = kTally == Tally::kLanes ? 1.f : 0.f;
        if (state.open)
          tallied += blend_pixel<kCap, kTally>(s, staged[i], colors + i * kCap, pixel, log2_alpha_min, at + i, state);
        if constexpr (kTallied) {
          const float sum = warp_sum(tallied);
          if (lane == 0) sums[warp * kChunk + i] = sum;
        }
      }
    }
    if constexpr (kTallied) {
      __syncthreads();
      for (int i = thread; i < count; i += kTileThreads) {
        float sum = 0.f;
        for (int w = 0; w < kTileWarps; ++w) sum += sums[w * kChunk + i];
        global(slot_sums)[global(entries.slots)[tile.begin + at + i]] = sum;
      }
    }
  }
  if (kTallied)
    for (int32_t i = at + thread; i < tile.count; i += kTileThreads)
      global(slot_sums)[global(entries.slots)[tile.begin + i]] = 0.f;
  if (pixel.inside) write_pixel(s, image, tile, pixel, state);
}

__global__ void __launch_bounds__(kTileThreads)
    sum_tallies_kernel(Entries entries, int64_t splats, const float* slot_sums, float* tally) {
  const int64_t row = int64_t{blockIdx.x} * kTileThreads + threadIdx.x;
  if (row >= splats) return;
  double sum = 0;
  for (int32_t k = global(entries.slot_ranges)[2 * row]; k < global(entries.slot_ranges)[2 * row + 1]; ++k)
    sum += global(slot_sums)[k];
  global(tally)[row] = static_cast<float>(sum);
}

template <int kCap, Tally kTally>
void launch_blend(const Splats<float>& s, const Entries& entries, const Image<float>& image, float* slot_sums,
                  Stream stream) {
  launch("blend", {s.tiles(), kTileThreads}, stream, blend_kernel<kCap, kTally>, s, entries, image, slot_sums);
}

void blend(const Splats<float>& s, const Entries& entries, const Image<float>& image, Stream stream) {
  with_channels(s.channels, [&](auto cap) {
    launch_blend<decltype(cap)::value, Tally::kNone>(s, entries, image, nullptr, stream);
  });
}

template <Tally kTally>
void blend_with_tally(const Splats<float>& s, const Entries& entries, const Image<float>& image, const Lent& workspace,
                      Stream stream) {
  auto* slot_sums = Workspace(workspace.memory, workspace.bytes).take<float>(entries.count);
  if (s.channels <= 4) {  // tallies are taken now and then: two kernels of each will do
    launch_blend<4, kTally>(s, entries, image, slot_sums, stream);
  } else {
    launch_blend<kMaxChannels, kTally>(s, entries, image, slot_sums, stream);
  }
  const int64_t splats = s.num_views * s.num_gaussians;
  launch("sum_tallies", {blocks_for(splats, kTileThreads), kTileThreads}, stream, sum_tallies_kernel, entries, splats,
         static_cast<const float*>(slot_sums), image.tally);
}

}  // namespace

int64_t rasterize_forward_workspace(int64_t num_entries, Tally tallied) {
  return tallied == Tally::kNone ? 0 : num_entries * int64_t{sizeof(float)};
}

void rasterize_forward(const Splats<float>& s, const Entries& entries, const Image<float>& image, const Lent& workspace,
                       Stream stream) {
  switch (image.tallied) {
    case Tally::kWeights: return blend_with_tally<Tally::kWeights>(s, entries, image, workspace, stream);
    case Tally::kPixels: return blend_with_tally<Tally::kPixels>(s, entries, image, workspace, stream);
    case Tally::kLanes: return blend_with_tally<Tally::kLanes>(s, entries, image, workspace, stream);
    case Tally::kSquaredSlopes:
      blend(s, entries, image, stream);  // the light behind a Gaussian is that of the finished image
      return blend_with_tally<Tally::kSquaredSlopes>(s, entries, image, workspace, stream);
    case Tally::kNone: return blend(s, entries, image, stream);
  }
}

}  // namespace dyngs::cuda

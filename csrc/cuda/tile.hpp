// Shared by the blending kernels: a block of 256 threads draws one tile of 16x16 pixels, each of its warps a block of 8x4. The
// entries of the tile are copied to shared memory piece by piece; each warp then tests 32 of them at a time, one per lane,
// against its 8x4 pixels, and walks only through those that may touch them.
#pragma once

#include "cuda/device.hpp"
#include "math/blend.hpp"
#include "math/ellipse.hpp"

namespace dyngs::cuda {

inline constexpr int kTileThreads = kTile * kTile, kTileWarps = kTileThreads / kWarpSize;
inline constexpr int kBlockColumns = 8, kBlockRows = 4;  // pixels of a warp

// Kernels are compiled for these numbers of channels; others take the next one, with zeros.
template <class Visit>
auto with_channels(int channels, const Visit& visit) {
  if (channels <= 1) return visit(std::integral_constant<int, 1>());
  if (channels <= 3) return visit(std::integral_constant<int, 3>());
  if (channels <= 4) return visit(std::integral_constant<int, 4>());
  if (channels <= 8) return visit(std::integral_constant<int, 8>());
  if (channels <= 16) return visit(std::integral_constant<int, 16>());
  return visit(std::integral_constant<int, kMaxChannels>());
}

// The tile of this block: its view, first pixel and entries.
struct TilePlace {
  int view, x0, y0;
  int64_t begin;
  int32_t count;
};

__device__ __forceinline__ TilePlace place_tile(const Splats<float>& s, const Entries& entries) {
  const int columns = (s.width + kTile - 1) / kTile, rows = (s.height + kTile - 1) / kTile;
  const int64_t tile = blockIdx.x, in_view = tile % (int64_t{columns} * rows);
  const int64_t begin = global(entries.tile_offsets)[tile], end = global(entries.tile_offsets)[tile + 1];
  return {static_cast<int>(tile / (int64_t{columns} * rows)), static_cast<int>(in_view % columns) * kTile,
          static_cast<int>(in_view / columns) * kTile, begin, static_cast<int32_t>(end - begin)};
}

// The pixel of this thread, and the first one of its warp; offsets from the tile's first pixel.
struct PixelPlace {
  int x, y, block_x, block_y;
  bool inside;    // the image
  int64_t index;  // within all views
};

__device__ __forceinline__ PixelPlace place_pixel(const Splats<float>& s, const TilePlace& tile) {
  const int lane = static_cast<int>(threadIdx.x) % kWarpSize, warp = static_cast<int>(threadIdx.x) / kWarpSize;
  PixelPlace p;
  p.block_x = warp % (kTile / kBlockColumns) * kBlockColumns, p.block_y = warp / (kTile / kBlockColumns) * kBlockRows;
  p.x = p.block_x + lane % kBlockColumns, p.y = p.block_y + lane / kBlockColumns;
  p.inside = tile.x0 + p.x < s.width && tile.y0 + p.y < s.height;
  p.index = (int64_t{tile.view} * s.height + tile.y0 + p.y) * s.width + tile.x0 + p.x;
  return p;
}

// A Gaussian as the pixels of one tile read it, and (u, v) at the tile's first pixel.
struct alignas(16) StagedGaussian {
  BlendGaussian<float> gaussian;
  Vec2<float> first;
};

__device__ __forceinline__ StagedGaussian stage_gaussian(const Splats<float>& s, const TilePlace& tile, int64_t row) {
  const Array<const float> m = global(s.means2d) + 2 * row, f = global(s.factors) + 3 * row;
  const float mean[2] = {m[0], m[1]}, factor[3] = {f[0], f[1], f[2]};
  StagedGaussian staged;
  staged.gaussian = blend_gaussian(mean, factor, static_cast<float>(global(s.opacities)[row]));
  staged.first = whitened_first(staged.gaussian, mean[0] - (static_cast<float>(tile.x0) + 0.5f),
                                mean[1] - (static_cast<float>(tile.y0) + 0.5f));
  return staged;
}

// Copies entries [at, at + count) of the tile. `colors`: kCap numbers each.
template <int kCap>
__device__ __forceinline__ void stage_entries(const Splats<float>& s, const Entries& entries, const TilePlace& tile,
                                              int32_t at, int count, const Array<StagedGaussian>& staged,
                                              const Array<float>& colors) {
  const Array<const int32_t> rows = global(entries.gaussians) + (tile.begin + at);
  const int thread = static_cast<int>(threadIdx.x);
  for (int i = thread; i < count; i += kTileThreads) staged[i] = stage_gaussian(s, tile, rows[i]);
  for (int k = thread; k < count * kCap; k += kTileThreads) {
    const int i = k / kCap, c = k % kCap;
    const int64_t row = rows[i];
    colors[k] = c < s.channels ? static_cast<float>(global(s.colors)[row * s.channels + c]) : 0.f;
  }
}

// True if alpha may reach alpha_min in the pixels of this warp.
__device__ __forceinline__ bool touches_block(const StagedGaussian& staged, const TilePlace& tile,
                                              const PixelPlace& pixel, float log2_alpha_min) {
  const BlendGaussian<float>& g = staged.gaussian;
  const float x0 = static_cast<float>(tile.x0 + pixel.block_x) + 0.5f - g.x;
  const float y0 = static_cast<float>(tile.y0 + pixel.block_y) + 0.5f - g.y;
  const float least = least_in_box(g.u, g.w, g.v, x0, y0, x0 + static_cast<float>(kBlockColumns - 1),
                                   y0 + static_cast<float>(kBlockRows - 1));
  return least <=
         g.log2_opacity - log2_alpha_min + 1e-3f;  // the pixel test decides; this one may err on the generous side
}

// log2 of alpha before clamping, at (x, y) from the tile's first pixel.
__device__ __forceinline__ float log2_alpha_in_tile(const StagedGaussian& staged, float x, float y) {
  const BlendGaussian<float>& g = staged.gaussian;
  return log2_alpha(g.log2_opacity, whitened(g.u, g.w, g.v, staged.first, x, y));
}

}  // namespace dyngs::cuda

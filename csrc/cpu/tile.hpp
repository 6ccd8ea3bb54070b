// Shared by the forward and the backward rasterizer: the Gaussians of one tile, copied into a compact form, and the test
// which of the tile's sixteen 4x4 blocks each of them can touch. One packet holds one block's 16 pixels.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/api.hpp"
#include "cpu/simd.hpp"
#include "math/blend.hpp"
#include "math/ellipse.hpp"

namespace dyngs {

inline constexpr int kBlockSide = 4, kBlocks = 16;
inline constexpr int kChunk = 256;  // Gaussians copied at a time: they stay in the L1 cache

inline constexpr int kDynamic = 0;         // number of channels known only at run time
inline constexpr int kInlineChannels = 4;  // colours of up to this many channels are copied beside the Gaussians

template <class S>
struct Chunk {
  int count;
  BlendGaussian<S> gaussians[kChunk];
  S inline_colors[kChunk][kInlineChannels];
  const S* color_rows[kChunk];  // where D is dynamic
  uint16_t masks[kChunk];       // bit b: block b may be touched

  // The D channels of entry `i`.
  template <int D>
  const S* color(int i) const {
    static_assert(D <= kInlineChannels);
    return D == kDynamic ? color_rows[i] : inline_colors[i];
  }

  // Positions within the chunk of the Gaussians that touch block `b`, in order. Branch free.
  int list_block(int b, uint16_t* list) const {
    int n = 0;
#if defined(__AVX512F__) && defined(__AVX512BW__) && defined(__AVX512VL__)
    const __m256i bit = _mm256_set1_epi16(static_cast<int16_t>(1u << b));
    __m512i index = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    for (int i = 0; i < count; i += 16) {
      const __m256i masks16 = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(masks + i));
      const __mmask16 hit = _mm256_test_epi16_mask(masks16, bit);
      const __m512i packed = _mm512_maskz_compress_epi32(hit, index);
      _mm256_storeu_si256(reinterpret_cast<__m256i*>(list + n), _mm512_cvtepi32_epi16(packed));
      n += __builtin_popcount(hit);
      index = _mm512_add_epi32(index, _mm512_set1_epi32(16));
    }
#else
    for (int i = 0; i < count; ++i) {
      list[n] = static_cast<uint16_t>(i);
      n += (masks[i] >> b) & 1;
    }
#endif
    return n;
  }
};

template <class S>
struct TileFrame {
  int x0, y0;  // top left pixel
  int view;
  Packet<S> block_x, block_y;  // first pixel centre of each block
  uint16_t inside;             // blocks that hold at least one pixel of the image
  S log2_alpha_min;
};

template <class S>
TileFrame<S> tile_frame(const Splats<S>& s, int64_t tile) {
  const int columns = (s.width + kTile - 1) / kTile, rows = (s.height + kTile - 1) / kTile;
  TileFrame<S> f;
  f.view = static_cast<int>(tile / (int64_t{columns} * rows));
  const int in_view = static_cast<int>(tile % (int64_t{columns} * rows));
  f.x0 = (in_view % columns) * kTile, f.y0 = (in_view / columns) * kTile;
  f.inside = 0;
  for (int b = 0; b < kBlocks; ++b) {
    const int x = f.x0 + kBlockSide * (b % 4), y = f.y0 + kBlockSide * (b / 4);
    f.block_x[b] = static_cast<S>(x) + S(0.5), f.block_y[b] = static_cast<S>(y) + S(0.5);
    if (x < s.width && y < s.height) f.inside |= static_cast<uint16_t>(1u << b);
  }
  f.log2_alpha_min = std::log2(s.alpha_min);
  return f;
}

// Bits of the blocks in which alpha may reach alpha_min.
template <class S>
uint16_t touched_blocks(const TileFrame<S>& f, const BlendGaussian<S>& g) {
  using P = Packet<S>;
  const P side(S(kBlockSide - 1)), x0 = f.block_x - P(g.x), y0 = f.block_y - P(g.y);
  const P least = least_in_box(g.u, g.w, g.v, x0, y0, x0 + side, y0 + side);
  const S slack = S(1e-3);  // the pixel test decides; this one may only err on the generous side
  return static_cast<uint16_t>(to_bits(least <= P(g.log2_opacity - f.log2_alpha_min + slack)) & f.inside);
}

inline constexpr int kPrefetch = 12;  // entries ahead: their Gaussians lie anywhere in memory

template <class S>
void prefetch(const Splats<S>& s, int64_t row) {
  __builtin_prefetch(s.means2d + 2 * row);
  __builtin_prefetch(s.factors + 3 * row);
  __builtin_prefetch(s.opacities + row);
  __builtin_prefetch(s.colors + row * s.channels);
}

// Copies entries [begin, begin + count) of a tile.
template <int D, class S>
[[gnu::noinline]] void load_chunk(const Splats<S>& s, const Entries& entries, const TileFrame<S>& frame, int64_t begin,
                                  int count, Chunk<S>& chunk) {
  chunk.count = count;
  for (int i = 0; i < count; ++i) {
    if (i + kPrefetch < count) prefetch(s, entries.gaussians[begin + i + kPrefetch]);
    const int64_t row = entries.gaussians[begin + i];
    BlendGaussian<S>& g = chunk.gaussians[i];
    g = blend_gaussian(s.means2d + 2 * row, s.factors + 3 * row, s.opacities[row]);
    chunk.color_rows[i] = s.colors + row * s.channels;
    for (int c = 0; c < D; ++c) chunk.inline_colors[i][c] = chunk.color_rows[i][c];
    chunk.masks[i] = touched_blocks(frame, g);
  }
  for (int i = count; i < std::min(kChunk, count + 16); ++i) chunk.masks[i] = 0;
}

// Offsets of a block's 16 pixels from its first one.
template <class S>
struct LaneOffsets {
  Packet<S> x, y;
  LaneOffsets() {
    for (int i = 0; i < kLanes; ++i) x[i] = static_cast<S>(i % kBlockSide), y[i] = static_cast<S>(i / kBlockSide);
  }
};

// The least log2 alpha that is drawn; infinite in lanes outside the image.
template <class S>
Packet<S> pixel_threshold(const Splats<S>& s, const TileFrame<S>& f, int block) {
  Packet<S> t;
  for (int i = 0; i < kLanes; ++i) {
    const int x = f.x0 + kBlockSide * (block % 4) + i % 4, y = f.y0 + kBlockSide * (block / 4) + i / 4;
    t[i] = x < s.width && y < s.height ? f.log2_alpha_min : std::numeric_limits<S>::infinity();
  }
  return t;
}

// Calls f(lane, pixel index within all views) for the block's pixels inside the image.
template <class S, class F>
void for_each_pixel(const Splats<S>& s, const TileFrame<S>& frame, int block, F&& f) {
  const int x0 = frame.x0 + kBlockSide * (block % 4), y0 = frame.y0 + kBlockSide * (block / 4);
  const int64_t first = (int64_t{frame.view} * s.height + y0) * s.width + x0;
  if (x0 + kBlockSide <= s.width && y0 + kBlockSide <= s.height) {  // as nearly always: no test per pixel
    for (int i = 0; i < kLanes; ++i) f(i, first + int64_t{i / kBlockSide} * s.width + i % kBlockSide);
    return;
  }
  for (int i = 0; i < kLanes; ++i) {
    const int x = i % kBlockSide, y = i / kBlockSide;
    if (x0 + x < s.width && y0 + y < s.height) f(i, first + int64_t{y} * s.width + x);
  }
}

}  // namespace dyngs

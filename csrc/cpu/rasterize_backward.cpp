// Backward pass of the blending, back to front (math/blend.hpp). For each Gaussian only sums over pixels are needed: the six
// moments of p = dL/dlog alpha, and of the blending weights times dL/dC. An entry of a tile visits the tile's blocks that it
// touches, adds to one packet per sum, and adds up the lanes once. The sums go to the entry's own slot, and are finally added
// up per Gaussian in slot order: no atomics, the same bytes for any thread count.
//
// The centre may lie far outside the image, 1e5 px where the splat is 1 px wide. Moments about it would be differences of
// numbers 1e10 times larger than they are. So a tile sums moments in x, y about the point of the tile nearest to the centre,
// a slot holds those with u and v about the point of the image nearest to it, and only the total is moved to the centre.
#include <memory>

#include "cpu/boundaries.hpp"
#include "cpu/lane_sums.hpp"
#include "cpu/parallel.hpp"
#include "cpu/tile.hpp"

namespace dyngs {
namespace {

// Fields of one entry's gradient record: moments, D colours, then |d mean x|, |d mean y| if asked for.
constexpr int kMaxFields = kBlendSums + kMaxChannels + 2;
constexpr int kPrefetchedSlots = 16;  // Gaussians ahead, when slots are added up

// The point nearest to (x, y) in the square of a tile's pixel centres.
template <class S>
Vec2<S> nearest_in_tile(const TileFrame<S>& frame, S x, S y) {
  const S x0 = static_cast<S>(frame.x0) + S(0.5), y0 = static_cast<S>(frame.y0) + S(0.5), side = S(kTile - 1);
  return {std::clamp(x, x0, x0 + side), std::clamp(y, y0, y0 + side)};
}
// The point nearest to (x, y) in the image.
template <class S>
Vec2<S> nearest_in_image(const Splats<S>& s, S x, S y) {
  return {std::clamp(x, S(0), static_cast<S>(s.width)), std::clamp(y, S(0), static_cast<S>(s.height))};
}

// A block's pixels: the running state of the backward recursion and the loss gradients.
template <class S, int D>
struct BlockPixels {
  BlendBehind<Packet<S>> behind;
  Packet<S> threshold;
  Packet<S> stop;                                    // relative to the chunk
  Packet<S> grad[D == kDynamic ? kMaxChannels : D];  // dL/dC per channel
};

template <class S, int D>
struct TileState {
  BlockPixels<S, D> blocks[kBlocks];
  int32_t stop[kBlocks][kLanes];
  int32_t last[kBlocks] = {};  // largest stop of the block; 0 outside the image
};

template <class S, int D>
void load_pixels(const Splats<S>& s, const TileFrame<S>& frame, int block, const ImageGrads<S>& image,
                 TileState<S, D>& state) {
  BlockPixels<S, D>& b = state.blocks[block];
  const int channels = D == kDynamic ? s.channels : D;
  b.behind = {Packet<S>(S(1)), Packet<S>(S(0))};
  b.threshold = pixel_threshold(s, frame, block);
  std::fill(state.stop[block], state.stop[block] + kLanes, 0);
  for (int c = 0; c < channels; ++c) b.grad[c] = Packet<S>(S(0));
  const S* background = image.background ? image.background + frame.view * channels : nullptr;
  for_each_pixel(s, frame, block, [&](int i, int64_t pixel) {
    b.behind.transmittance[i] = image.final_transmittance[pixel];
    state.stop[block][i] = image.stop[pixel];
    state.last[block] = std::max(state.last[block], image.stop[pixel]);
    S light = image.transmittance[pixel];
    for (int c = 0; c < channels; ++c) {
      b.grad[c][i] = image.color[pixel * channels + c];
      if (background) light += background[c] * b.grad[c][i];
    }
    b.behind.light[i] = light;
  });
}

// Positions at which the pixels were full, relative to the chunk.
template <class S>
Packet<S> relative_stop(const int32_t (&stop)[kLanes], int32_t chunk_begin) {
  Packet<S> r;
  for (int i = 0; i < kLanes; ++i)
    r[i] = static_cast<S>(std::clamp<int64_t>(int64_t{stop[i]} - chunk_begin, 0, kChunk));
  return r;
}

// Adds one block's pixels to the sums of entry `i` of the chunk, whose anchor is the point (x, y). `bound`, `by_bound`: the
// weights of its patch and the gradient by their logarithms, if bounded.
template <class S, int D, bool kAbsolute, bool kBounded>
DYNGS_INLINE void add_block(const BlendGaussian<S>& g, const S* color, int channels, int i, const LaneOffsets<S>& lane,
                            const Vec2<S>& block, const Vec2<S>& anchor, S alpha_min, S alpha_max,
                            const Packet<S>* bound, Packet<S>* by_bound, BlockPixels<S, D>& pixels, Packet<S>* sum) {
  using P = Packet<S>;
  const P x = log2_alpha(g, g.x - block.x, g.y - block.y, lane.x, lane.y);
  PacketMask<S> drawn = (x >= pixels.threshold) & (P(static_cast<S>(i)) < pixels.stop);
  P raw = exp2(x);
  if constexpr (kBounded) {
    raw = raw * *bound;
    drawn = drawn & (raw >= P(alpha_min));
  }
  const P alpha = clamped_alpha(raw, P(alpha_max), drawn);
  P shade(S(0));
  for (int c = 0; c < channels; ++c) shade += P(color[c]) * pixels.grad[c];
  const BlendGrad<P> grad = blend_vjp(raw, alpha, P(alpha_max), shade, pixels.behind);
  const P p = grad.by_log_alpha, dx = P(anchor.x - block.x) - lane.x, dy = P(anchor.y - block.y) - lane.y;
  const P px = p * dx, py = p * dy;
  if constexpr (kBounded) *by_bound += p;
  sum[kOne] += p, sum[kX] += px, sum[kY] += py;
  sum[kXX] += px * dx, sum[kXY] += px * dy, sum[kYY] += py * dy;
  for (int c = 0; c < channels; ++c) sum[kBlendSums + c] += grad.weight * pixels.grad[c];
  if constexpr (kAbsolute) {  // absolute values do not factor into moments
    const Vec2<S> first = whitened_first(g, g.x - block.x, g.y - block.y);
    const Vec2<P> at = whitened(P(g.u), P(g.w), P(g.v), Vec2<P>{P(first.x), P(first.y)}, lane.x, lane.y);
    const Vec2<P> slope = slope_by_mean(p, P(g.u), P(g.w), P(g.v), at);
    sum[kBlendSums + channels] += abs(slope.x), sum[kBlendSums + channels + 1] += abs(slope.y);
  }
}

// Turns the moments of one entry about its anchor in the tile into the sums of its slot.
template <class S>
void write_moments(const Splats<S>& s, const Vec2<S>& anchor, const BlendGaussian<S>& g, const S* sum, S* to) {
  const double unscale = 1 / std::sqrt(0.5 * kLog2E);  // a BlendGaussian holds u, w, v times sqrt(log2(e) / 2)
  const double u = g.u * unscale, w = g.w * unscale, v = g.v * unscale;
  const Vec2<S> near = nearest_in_image(s, g.x, g.y);
  const Vec2<double> far{double(g.x) - anchor.x, double(g.y) - anchor.y};  // 0 where the centre is in the tile
  blend_sums(sum, u, w, v, far, {double(near.x) - anchor.x, double(near.y) - anchor.y}, to);
}

// Entry `i` of the chunk in the blocks of the bits `touched`; writes its slot. `patch`: of the Gaussian, if bounded.
template <class S, int D, bool kAbsolute, bool kBounded>
void entry_backward(const Splats<S>& s, const TileFrame<S>& frame, const Chunk<S>& chunk, int i, uint32_t touched,
                    int32_t patch, const BlockBoundary<S>* bounds, const LaneOffsets<S>& lane, TileState<S, D>& state,
                    S* slot) {
  using P = Packet<S>;
  constexpr int kFixed = kBlendSums + (kAbsolute ? 2 : 0);
  const int channels = D == kDynamic ? s.channels : D;
  const BlendGaussian<S> g = chunk.gaussians[i];
  const S* color = chunk.template color<D>(i);
  const Vec2<S> anchor = nearest_in_tile(frame, g.x, g.y);
  P sum[D == kDynamic ? (kMaxFields + kLanes - 1) / kLanes * kLanes : kFixed + D];
  S fields[sizeof(sum) / sizeof(P)];
  const int count = kFixed + channels;
  for (int f = 0; f < count; ++f) sum[f] = P(S(0));
  for (; touched != 0; touched &= touched - 1) {
    const int b = __builtin_ctz(touched);
    const P* bound = nullptr;
    P* by_bound = nullptr;
    if constexpr (kBounded) {
      const int at = bounds[b].find(patch);
      if (at == bounds[b].count) continue;
      bound = bounds[b].weights + at, by_bound = bounds[b].grads + at;
    }
    add_block<S, D, kAbsolute, kBounded>(g, color, channels, i, lane, {frame.block_x[b], frame.block_y[b]}, anchor,
                                         s.alpha_min, s.alpha_max, bound, by_bound, state.blocks[b], sum);
  }
  if constexpr (D == kDynamic) {
    for (int f = count; f % kLanes != 0; ++f) sum[f] = P(S(0));
    for (int f = 0; f < count; f += kLanes) lane_sums(reinterpret_cast<P(&)[kLanes]>(sum[f]), fields + f);
  } else {
    lane_sums(sum, fields);
  }
  write_moments(s, anchor, g, fields, slot);
  std::copy(fields + kBlendSums, fields + kBlendSums + channels, slot + kBlendSums);
  if constexpr (kAbsolute) {
    const S unscale = S(2) / S(kLog2E);
    for (int k = count - 2; k < count; ++k) slot[k] = fields[k] * unscale;
  }
}

template <class S, int D, bool kAbsolute, bool kBounded>
void tile_backward(const Splats<S>& s, const Entries& entries, BoundaryTable<S>* boundaries, const ImageGrads<S>& image,
                   int64_t tile, S* slots) {
  const TileFrame<S> frame = tile_frame(s, tile);
  const int64_t begin = entries.tile_offsets[tile], end = entries.tile_offsets[tile + 1];
  if (begin == end) return;
  const int fields = kBlendSums + s.channels + (kAbsolute ? 2 : 0);
  TileState<S, D> state;
  for (int b = 0; b < kBlocks; ++b)
    if (frame.inside >> b & 1) load_pixels(s, frame, b, image, state);
  BlockBoundary<S> bounds[kBlocks];
  if constexpr (kBounded) boundaries->load_tile(frame, bounds);
  Chunk<S> chunk;
  const LaneOffsets<S> lane;
  for (int64_t at = begin + (end - begin - 1) / kChunk * kChunk; at >= begin; at -= kChunk) {
    const int count = static_cast<int>(std::min<int64_t>(kChunk, end - at));
    const int32_t chunk_begin = static_cast<int32_t>(at - begin);
    uint32_t open = 0;  // blocks that saw something of the chunk
    for (int b = 0; b < kBlocks; ++b) {
      if (state.last[b] <= chunk_begin) continue;
      open |= 1u << b;
      state.blocks[b].stop = relative_stop<S>(state.stop[b], chunk_begin);
    }
    if (open != 0) load_chunk<D>(s, entries, frame, at, count, chunk);
    for (int i = count - 1; i >= 0; --i) {
      S* slot = slots + int64_t{entries.slots[at + i]} * fields;
      const uint32_t touched = open != 0 ? chunk.masks[i] & open : 0;
      if (touched == 0)  // behind what the pixels see
        std::fill(slot, slot + fields, S(0));
      else
        entry_backward<S, D, kAbsolute, kBounded>(s, frame, chunk, i, touched,
                                                  kBounded ? boundaries->patch(entries.gaussians[at + i]) : 0, bounds,
                                                  lane, state, slot);
    }
  }
}

// `sum`: a record, as in a slot.
template <class S>
void write_gaussian(const Splats<S>& s, int64_t row, const double* sum, const SplatGrads<S>& out) {
  const S mean_x = s.means2d[2 * row], mean_y = s.means2d[2 * row + 1];
  const Vec2<S> near = nearest_in_image(s, mean_x, mean_y);
  const S* factor = s.factors + 3 * row;
  const BlendSplatGrad<S> grad = splat_grad<S>(sum, factor[0], factor[1], factor[2], s.opacities[row],
                                               {double(mean_x) - near.x, double(mean_y) - near.y});
  out.means2d[2 * row] = grad.mean.x, out.means2d[2 * row + 1] = grad.mean.y;
  out.factors[3 * row] = grad.u, out.factors[3 * row + 1] = grad.w, out.factors[3 * row + 2] = grad.v;
  out.opacities[row] = grad.opacity;
  const double* channels = sum + kBlendSums;
  for (int c = 0; c < s.channels; ++c) out.colors[row * s.channels + c] = static_cast<S>(channels[c]);
  if (out.probe == nullptr) return;
  out.probe[4 * row] = grad.mean.x, out.probe[4 * row + 1] = grad.mean.y;
  for (int k = 0; k < 2; ++k)
    out.probe[4 * row + 2 + k] = out.absolute ? static_cast<S>(channels[s.channels + k]) : S(0);
}

// Adds up the slots of each Gaussian. `kFields`: their number of fields, 0 if known only at run time.
template <class S, int kFields>
void sum_slots(const Splats<S>& s, int num_fields, const Entries& entries, const S* slots, const SplatGrads<S>& out) {
  const int fields = kFields > 0 ? kFields : num_fields;
  const int64_t rows = s.num_views * s.num_gaussians;
  parallel_for(rows, 1024, s.threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      if (i + kPrefetchedSlots < rows) {  // slots lie in the order of depth
        const S* ahead = slots + int64_t{entries.slot_ranges[2 * (i + kPrefetchedSlots)]} * fields;
        __builtin_prefetch(ahead), __builtin_prefetch(ahead + fields);
      }
      double sum[kFields > 0 ? kFields : kMaxFields];
      std::fill(sum, sum + fields, 0.0);
      for (int64_t k = entries.slot_ranges[2 * i]; k < entries.slot_ranges[2 * i + 1]; ++k)
        for (int f = 0; f < fields; ++f) sum[f] += slots[k * fields + f];
      write_gaussian(s, i, sum, out);
    }
  });
}

template <class S, int D, bool kAbsolute, bool kBounded = false>
void backward(const Splats<S>& s, const Entries& entries, const ImageGrads<S>& image, const SplatGrads<S>& out,
              BoundaryTable<S>* boundaries = nullptr) {
  constexpr int kFixed = kBlendSums + (kAbsolute ? 2 : 0);
  const int fields = kFixed + s.channels;
  const auto slots = std::make_unique_for_overwrite<S[]>(static_cast<size_t>(entries.count) * fields);
  parallel_for(s.tiles(), 1, s.threads, [&](int64_t begin, int64_t end) {
    for (int64_t t = begin; t < end; ++t)
      tile_backward<S, D, kAbsolute, kBounded>(s, entries, boundaries, image, t, slots.get());
  });
  sum_slots<S, D == kDynamic ? 0 : kFixed + D>(s, fields, entries, slots.get(), out);
}

template <class S, bool kAbsolute>
void backward_of_channels(const Splats<S>& s, const Entries& entries, const ImageGrads<S>& image,
                          const SplatGrads<S>& out) {
  switch (s.channels) {
    case 1: return backward<S, 1, kAbsolute>(s, entries, image, out);
    case 3: return backward<S, 3, kAbsolute>(s, entries, image, out);
    case 4: return backward<S, 4, kAbsolute>(s, entries, image, out);
    default: return backward<S, kDynamic, kAbsolute>(s, entries, image, out);
  }
}

}  // namespace

template <class S>
void rasterize_backward(const Splats<S>& s, const Entries& entries, const ImageGrads<S>& image,
                        const SplatGrads<S>& out) {
  out.absolute ? backward_of_channels<S, true>(s, entries, image, out)
               : backward_of_channels<S, false>(s, entries, image, out);
}

template <class S>
void rasterize_bounded_backward(const Splats<S>& s, const Entries& entries, const Boundaries<S>& boundaries,
                                const ImageGrads<S>& image, const SplatGrads<S>& out, S* g_samples) {
  BoundaryTable<S> table(boundaries, s.width, s.height, s.threads);
  s.channels == 3 ? backward<S, 3, false, true>(s, entries, image, out, &table)
                  : backward<S, kDynamic, false, true>(s, entries, image, out, &table);
  table.sample_grads(s.num_gaussians, g_samples);
}

template void rasterize_backward<float>(const Splats<float>&, const Entries&, const ImageGrads<float>&,
                                        const SplatGrads<float>&);
template void rasterize_backward<double>(const Splats<double>&, const Entries&, const ImageGrads<double>&,
                                         const SplatGrads<double>&);
template void rasterize_bounded_backward<float>(const Splats<float>&, const Entries&, const Boundaries<float>&,
                                                const ImageGrads<float>&, const SplatGrads<float>&, float*);
template void rasterize_bounded_backward<double>(const Splats<double>&, const Entries&, const Boundaries<double>&,
                                                 const ImageGrads<double>&, const SplatGrads<double>&, double*);

}  // namespace dyngs

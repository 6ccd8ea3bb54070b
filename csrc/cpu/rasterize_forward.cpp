// Front-to-back blending of each tile's Gaussians. Pixel state (transmittance, colour) of one 4x4 block stays in
// registers while the block's own list is walked.
#include <numeric>

#include "cpu/boundaries.hpp"
#include "cpu/parallel.hpp"
#include "cpu/tile.hpp"

namespace dyngs {
namespace {

template <class S, int D>
struct BlockState {
  Packet<S> transmittance, threshold;
  Packet<S> color[D == kDynamic ? kMaxChannels : D];
  Packet<S> behind;  // kSquaredSlopes: the light, over all channels, that reaches the pixel from here on
  int32_t stop[kLanes];
};

template <class S>
struct Scratch {
  Chunk<S> chunk;
  uint16_t list[kChunk + 16];
  S sums[kChunk];           // tallies of the chunk's Gaussians
  int32_t patches[kChunk];  // of these Gaussians, if bounded
};

// Closes pixels that the Gaussian would take below transmittance_min.
template <class S, int D>
void mark_full(PacketMask<S> full, int32_t position, BlockState<S, D>& state) {
  uint32_t bits = to_bits(full);
  state.threshold = select(full, Packet<S>(std::numeric_limits<S>::infinity()), state.threshold);
  for (; bits != 0; bits &= bits - 1) state.stop[__builtin_ctz(bits)] = position;
}

template <class S, int D, Tally kTally, bool kBounded>
void blend_block(const Splats<S>& s, const TileFrame<S>& frame, int block, int32_t chunk_begin, int listed,
                 const BlockBoundary<S>& boundary, Scratch<S>& scratch, BlockState<S, D>& block_state) {
  using P = Packet<S>;
  const int channels = D == kDynamic ? s.channels : D;
  const LaneOffsets<S> lane;
  const S px = frame.block_x[block], py = frame.block_y[block];
  const P alpha_max(s.alpha_max), transmittance_min(s.transmittance_min), zero(S(0));
  BlockState<S, D> state = block_state;
  for (int k = 0; k < listed; ++k) {
    const int i = scratch.list[k];
    const BlendGaussian<S>& g = scratch.chunk.gaussians[i];
    const P x = log2_alpha(g, g.x - px, g.y - py, lane.x, lane.y);
    PacketMask<S> drawn = x >= state.threshold;
    P raw = exp2(x);
    if constexpr (kBounded) {
      const int at = boundary.find(scratch.patches[i]);
      if (at == boundary.count) continue;
      raw = raw * boundary.weights[at];
      drawn = drawn & (raw >= P(s.alpha_min));
    }
    const P alpha = clamped_alpha(raw, alpha_max, drawn);
    const P before = state.transmittance;
    BlendStep<P> step = blend_step(alpha, before, transmittance_min);
    if (any(step.full)) [[unlikely]] {
      mark_full(step.full, chunk_begin + i, state);
      leave_full(before, step);
    }
    const P weight = step.weight;
    state.transmittance = step.transmittance;
    const S* color = scratch.chunk.template color<D>(i);
    for (int c = 0; c < channels; ++c) state.color[c] += weight * P(color[c]);
    if constexpr (kTally == Tally::kWeights) scratch.sums[i] += horizontal_sum(weight);
    if constexpr (kTally == Tally::kPixels)
      scratch.sums[i] += static_cast<S>(__builtin_popcount(to_bits(weight > zero)));
    if constexpr (kTally == Tally::kLanes) scratch.sums[i] += static_cast<S>(kLanes);
    if constexpr (kTally == Tally::kSquaredSlopes) {
      const S shade = std::accumulate(color, color + channels, S(0));
      const P own = weight * P(shade);
      const P slope = slope_by_alpha(alpha, before, P(shade), own, state.behind);
      const P scaled = P(exp2(g.log2_opacity)) * slope;
      const PacketMask<S> free = drawn & !step.full & (alpha < alpha_max);  // the clamp stops the gradient
      scratch.sums[i] += horizontal_sum(select(free, scaled * scaled, zero));
      state.behind -= own;
    }
  }
  block_state = state;
}

template <class S, int D>
void write_block(const Splats<S>& s, const TileFrame<S>& frame, int block, const Image<S>& image,
                 const BlockState<S, D>& state) {
  const int channels = D == kDynamic ? s.channels : D;
  Packet<S> color[D == kDynamic ? kMaxChannels : D];
  for (int c = 0; c < channels; ++c) {
    const S behind = image.background ? image.background[frame.view * channels + c] : S(0);
    color[c] = state.color[c] + state.transmittance * Packet<S>(behind);
  }
  for_each_pixel(s, frame, block, [&](int i, int64_t pixel) {
    image.transmittance[pixel] = state.transmittance[i];
    image.stop[pixel] = state.stop[i];
    for (int c = 0; c < channels; ++c) image.color[pixel * channels + c] = color[c][i];
  });
}

template <class S, int D>
bool any_open(const BlockState<S, D>& state) {
  return any(state.threshold < Packet<S>(std::numeric_limits<S>::infinity()));
}

// Sums over the channels of a block's finished pixels.
template <class S>
Packet<S> light_of_block(const Splats<S>& s, const TileFrame<S>& frame, int block, const Image<S>& image) {
  Packet<S> light(S(0));
  for_each_pixel(s, frame, block, [&](int i, int64_t pixel) {
    const S* color = image.color + pixel * s.channels;
    light[i] = std::accumulate(color, color + s.channels, S(0));
  });
  return light;
}

// Writes the background into a tile without Gaussians.
template <class S>
void fill_tile(const Splats<S>& s, const TileFrame<S>& frame, const Image<S>& image) {
  const int x1 = std::min(frame.x0 + kTile, s.width), y1 = std::min(frame.y0 + kTile, s.height);
  const int64_t count = x1 - frame.x0;
  S row[kTile * kMaxChannels] = {};
  if (image.background)
    for (int64_t i = 0; i < count; ++i)
      std::copy_n(image.background + frame.view * s.channels, s.channels, row + i * s.channels);
  for (int y = frame.y0; y < y1; ++y) {
    const int64_t first = (int64_t{frame.view} * s.height + y) * s.width + frame.x0;
    std::fill_n(image.transmittance + first, count, S(1));
    std::fill_n(image.stop + first, count, std::numeric_limits<int32_t>::max());
    std::copy_n(row, count * s.channels, image.color + first * s.channels);
  }
}

template <class S, int D, Tally kTally, bool kBounded>
void blend_tile(const Splats<S>& s, const Entries& entries, BoundaryTable<S>* boundaries, const Image<S>& image,
                int64_t tile, S* slot_sums) {
  const TileFrame<S> frame = tile_frame(s, tile);
  const int64_t begin = entries.tile_offsets[tile], end = entries.tile_offsets[tile + 1];
  if (begin == end) return fill_tile(s, frame, image);
  BlockState<S, D> state[kBlocks];
  for (int b = 0; b < kBlocks; ++b) {
    state[b] = {};
    state[b].transmittance = Packet<S>(S(1));
    state[b].threshold = pixel_threshold(s, frame, b);
    std::fill(state[b].stop, state[b].stop + kLanes, std::numeric_limits<int32_t>::max());
    if constexpr (kTally == Tally::kSquaredSlopes) state[b].behind = light_of_block(s, frame, b, image);
  }
  BlockBoundary<S> bounds[kBlocks];
  if constexpr (kBounded) boundaries->load_tile(frame, bounds);
  Scratch<S> scratch;
  uint32_t open = frame.inside;
  for (int64_t at = begin; at < end && open != 0; at += kChunk) {
    load_chunk<D>(s, entries, frame, at, static_cast<int>(std::min<int64_t>(kChunk, end - at)), scratch.chunk);
    if constexpr (kTally != Tally::kNone) std::fill(scratch.sums, scratch.sums + kChunk, S(0));
    for (int i = 0; kBounded && i < scratch.chunk.count; ++i)
      scratch.patches[i] = boundaries->patch(entries.gaussians[at + i]);
    for (int b = 0; b < kBlocks; ++b) {
      if (!(open >> b & 1)) continue;
      const int listed = scratch.chunk.list_block(b, scratch.list);
      blend_block<S, D, kTally, kBounded>(s, frame, b, static_cast<int32_t>(at - begin), listed, bounds[b], scratch,
                                          state[b]);
      if (!any_open(state[b])) open &= ~(1u << b);
    }
    if constexpr (kTally != Tally::kNone)
      for (int i = 0; i < scratch.chunk.count; ++i) slot_sums[entries.slots[at + i]] = scratch.sums[i];
  }
  for (int b = 0; b < kBlocks; ++b)
    if (frame.inside >> b & 1) write_block(s, frame, b, image, state[b]);
}

template <class S, int D, Tally kTally, bool kBounded = false>
void blend_all(const Splats<S>& s, const Entries& entries, const Image<S>& image, S* slot_sums,
               BoundaryTable<S>* boundaries = nullptr) {
  parallel_for(s.tiles(), 1, s.threads, [&](int64_t begin, int64_t end) {
    for (int64_t t = begin; t < end; ++t)
      blend_tile<S, D, kTally, kBounded>(s, entries, boundaries, image, t, slot_sums);
  });
}

// Sums tallies per entry, then per Gaussian in slot order: the same for any thread count.
template <class S, Tally kTally>
void blend_with_tally(const Splats<S>& s, const Entries& entries, const Image<S>& image) {
  std::vector<S> slot_sums(entries.count, S(0));
  blend_all<S, kDynamic, kTally>(s, entries, image, slot_sums.data());
  for (int64_t i = 0; i < s.num_views * s.num_gaussians; ++i) {
    S sum = 0;
    for (int64_t k = entries.slot_ranges[2 * i]; k < entries.slot_ranges[2 * i + 1]; ++k) sum += slot_sums[k];
    image.tally[i] = sum;
  }
}

template <class S>
void blend(const Splats<S>& s, const Entries& entries, const Image<S>& image) {
  switch (s.channels) {
    case 1: return blend_all<S, 1, Tally::kNone>(s, entries, image, nullptr);
    case 3: return blend_all<S, 3, Tally::kNone>(s, entries, image, nullptr);
    case 4: return blend_all<S, 4, Tally::kNone>(s, entries, image, nullptr);
    default: return blend_all<S, kDynamic, Tally::kNone>(s, entries, image, nullptr);
  }
}

}  // namespace

template <class S>
void rasterize_forward(const Splats<S>& s, const Entries& entries, const Image<S>& image) {
  switch (image.tallied) {
    case Tally::kWeights: return blend_with_tally<S, Tally::kWeights>(s, entries, image);
    case Tally::kPixels: return blend_with_tally<S, Tally::kPixels>(s, entries, image);
    case Tally::kLanes: return blend_with_tally<S, Tally::kLanes>(s, entries, image);
    case Tally::kSquaredSlopes:
      blend(s, entries, image);  // the light behind a Gaussian is taken from the finished image
      return blend_with_tally<S, Tally::kSquaredSlopes>(s, entries, image);
    case Tally::kNone: return blend(s, entries, image);
  }
}

template <class S>
void rasterize_bounded_forward(const Splats<S>& s, const Entries& entries, const Boundaries<S>& boundaries,
                               const Image<S>& image) {
  BoundaryTable<S> table(boundaries, s.width, s.height, s.threads);
  s.channels == 3 ? blend_all<S, 3, Tally::kNone, true>(s, entries, image, nullptr, &table)
                  : blend_all<S, kDynamic, Tally::kNone, true>(s, entries, image, nullptr, &table);
}

template void rasterize_forward<float>(const Splats<float>&, const Entries&, const Image<float>&);
template void rasterize_forward<double>(const Splats<double>&, const Entries&, const Image<double>&);
template void rasterize_bounded_forward<float>(const Splats<float>&, const Entries&, const Boundaries<float>&,
                                               const Image<float>&);
template void rasterize_bounded_forward<double>(const Splats<double>&, const Entries&, const Boundaries<double>&,
                                                const Image<double>&);

}  // namespace dyngs

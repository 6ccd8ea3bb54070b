// Backward pass of the blending, back to front (math/blend.hpp). For each Gaussian only sums over pixels are needed: the six
// moments of p = dL/dlog alpha, and of the blending weights times dL/dC. They are taken 16 Gaussians at a time after a
// transpose, added up per tile entry, written to the entry's own slot, and finally summed per Gaussian in slot order: no
// atomics, the same bytes for any thread count.
//
// The centre may lie far outside the image, 1e5 px where the splat is 1 px wide. Moments about it would be differences of
// numbers 1e10 times larger than they are. So a tile sums moments in x, y about the point of the tile nearest to the centre,
// a slot holds those with u and v about the point of the image nearest to it, and only the total is moved to the centre.
#include <array>
#include <memory>

#include "cpu/parallel.hpp"
#include "cpu/tile.hpp"
#include "cpu/transpose.hpp"

namespace dyngs {
namespace {

constexpr int kMaxFields = 48;  // moments, channels, two absolute gradients; padded to whole packets
static_assert(kBlendSums + kMaxChannels + 2 <= kMaxFields);

// Fields of one entry's gradient record: moments, D colours, then |d mean x|, |d mean y| if asked for.
struct Layout {
  int channels;
  bool absolute;
  int fields() const { return kBlendSums + channels + (absolute ? 2 : 0); }
  int packets() const { return (fields() + kLanes - 1) / kLanes; }
};

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

// Up to 16 Gaussians of one block, waiting for the transpose.
template <class S>
struct Batch {
  Packet<S> p[kLanes], weight[kLanes];  // row: Gaussian, lane: pixel
  Packet<S> dx, dy;                     // lane: Gaussian; its anchor minus the block's first pixel centre
  int index[kLanes];
  int count = 0;
};

template <class S>
struct Scratch {
  Chunk<S> chunk;
  uint16_t list[kChunk + 16];
  Batch<S> batch;
  Packet<S> sums[kChunk * kMaxFields / kLanes];  // gradient records of the chunk, padded to whole packets
};

// A block's pixels: loss gradients and the running state of the backward recursion.
template <class S>
struct BlockPixels {
  BlendBehind<Packet<S>> behind;
  Packet<S> threshold;
  Packet<S> grad[kMaxChannels];       // dL/dC per channel, lane: pixel
  S grad_rows[kMaxChannels][kLanes];  // the same, to broadcast one pixel
  int32_t stop[kLanes];
  int32_t last = 0;  // largest stop
};

template <class S>
BlockPixels<S> load_pixels(const Splats<S>& s, const TileFrame<S>& frame, int block, const ImageGrads<S>& image) {
  BlockPixels<S> b;
  const int channels = s.channels;
  b.behind = {Packet<S>(S(1)), Packet<S>(S(0))};
  b.threshold = pixel_threshold(s, frame, block);
  std::fill(b.stop, b.stop + kLanes, 0);
  for (int c = 0; c < channels; ++c) b.grad[c] = Packet<S>(S(0));
  const S* background = image.background ? image.background + frame.view * channels : nullptr;
  for_each_pixel(s, frame, block, [&](int i, int64_t pixel) {
    b.behind.transmittance[i] = image.final_transmittance[pixel];
    b.stop[i] = image.stop[pixel];
    b.last = std::max(b.last, b.stop[i]);
    S light = image.transmittance[pixel];
    for (int c = 0; c < channels; ++c) {
      b.grad[c][i] = image.color[pixel * channels + c];
      if (background) light += background[c] * b.grad[c][i];
    }
    b.behind.light[i] = light;
  });
  for (int c = 0; c < channels; ++c) b.grad[c].store(b.grad_rows[c]);
  return b;
}

// Sums over the block's pixels of p times the powers of the lane offsets, for 16 Gaussians (rows already transposed),
// turned into moments about each Gaussian's anchor in the tile: dx = batch.dx - lane.x.
template <class S>
void add_moments(const Packet<S> (&p)[kLanes], const Batch<S>& batch, Packet<S>* out) {
  using P = Packet<S>;
  P one(S(0)), x(S(0)), y(S(0)), xx(S(0)), xy(S(0)), yy(S(0));  // an array of them would live in memory
  for (int r = 0; r < kBlockSide; ++r) {
    const P &a = p[4 * r], &b = p[4 * r + 1], &c = p[4 * r + 2], &d = p[4 * r + 3];
    const P row = (a + b) + (c + d), row_x = b + P(S(2)) * c + P(S(3)) * d;
    const P fy(static_cast<S>(r)), fyy(static_cast<S>(r * r));
    one += row, x += row_x, xx += b + P(S(4)) * c + P(S(9)) * d;
    y += fy * row, xy += fy * row_x, yy += fyy * row;
  }
  const P sum[] = {one, x, y, xx, xy, yy};
  moments_about(sum, batch.dx, batch.dy, out);
}

// Sums over the block's pixels of |p d(log alpha)/d(mean)|: absolute values do not factor into moments.
template <class S>
void add_absolute(const Packet<S> (&p)[kLanes], const Batch<S>& batch, const Chunk<S>& chunk, S px, S py,
                  Packet<S>* out) {
  using P = Packet<S>;
  P u, w, v, first_a, first_b;
  for (int i = 0; i < kLanes; ++i) {
    const BlendGaussian<S>& g = chunk.gaussians[batch.index[i]];
    u[i] = g.u, w[i] = g.w, v[i] = g.v;
    first_a[i] = g.u * (g.x - px) + g.w * (g.y - py), first_b[i] = g.v * (g.y - py);
  }
  P sum_x(S(0)), sum_y(S(0));
  for (int i = 0; i < kLanes; ++i) {
    const P x(static_cast<S>(i % kBlockSide)), y(static_cast<S>(i / kBlockSide));
    const Vec2<P> slope = slope_by_mean(p[i], u, w, v, whitened(u, w, v, Vec2<P>{first_a, first_b}, x, y));
    sum_x += abs(slope.x);
    sum_y += abs(slope.y);
  }
  const P unscale(S(2) / S(kLog2E));  // a BlendGaussian holds u, w, v times sqrt(log2(e) / 2)
  out[0] = sum_x * unscale;
  out[1] = sum_y * unscale;
}

// `px`, `py`: the block's first pixel centre.
template <class S>
void flush(const Layout& layout, S px, S py, const BlockPixels<S>& pixels, Scratch<S>& scratch) {
  Batch<S>& batch = scratch.batch;
  if (batch.count == 0) return;
  for (int i = batch.count; i < kLanes; ++i) {
    batch.p[i] = batch.weight[i] = Packet<S>(S(0));
    batch.dx[i] = batch.dy[i] = S(0);
    batch.index[i] = batch.index[0];
  }
  transpose16(batch.p);
  transpose16(batch.weight);
  Packet<S> fields[kMaxFields];
  add_moments(batch.p, batch, fields);
  for (int c = 0; c < layout.channels; ++c) {
    Packet<S> even(S(0)), odd(S(0));
    for (int i = 0; i < kLanes; i += 2) {
      even += batch.weight[i] * Packet<S>(pixels.grad_rows[c][i]);
      odd += batch.weight[i + 1] * Packet<S>(pixels.grad_rows[c][i + 1]);
    }
    fields[kBlendSums + c] = even + odd;
  }
  if (layout.absolute) add_absolute(batch.p, batch, scratch.chunk, px, py, fields + kBlendSums + layout.channels);
  const int packets = layout.packets();
  for (int i = layout.fields(); i < packets * kLanes; ++i) fields[i] = Packet<S>(S(0));
  for (int k = 0; k < packets; ++k) {
    Packet<S>(&group)[kLanes] = *reinterpret_cast<Packet<S>(*)[kLanes]>(fields + k * kLanes);
    transpose16(group);
    for (int i = 0; i < batch.count; ++i) scratch.sums[batch.index[i] * packets + k] += group[i];
  }
  batch.count = 0;
}

// Positions at which the pixels were full, relative to the chunk.
template <class S>
Packet<S> relative_stop(const BlockPixels<S>& pixels, int32_t chunk_begin) {
  Packet<S> r;
  for (int i = 0; i < kLanes; ++i)
    r[i] = static_cast<S>(std::clamp<int64_t>(int64_t{pixels.stop[i]} - chunk_begin, 0, kChunk));
  return r;
}

template <class S, int D>
void block_backward(const Splats<S>& s, const Layout& layout, const TileFrame<S>& frame, int block, int32_t chunk_begin,
                    int listed, BlockPixels<S>& pixels, Scratch<S>& scratch) {
  using P = Packet<S>;
  const S px = frame.block_x[block], py = frame.block_y[block];
  const int channels = D == kDynamic ? layout.channels : D;
  const LaneOffsets<S> lane;
  const P alpha_max(s.alpha_max);
  const P stop = relative_stop(pixels, chunk_begin);
  Batch<S>& batch = scratch.batch;
  BlendBehind<P> behind = pixels.behind;
  for (int k = listed - 1; k >= 0; --k) {
    const int i = scratch.list[k];
    const BlendGaussian<S>& g = scratch.chunk.gaussians[i];
    const P x = log2_alpha(g, g.x - px, g.y - py, lane.x, lane.y);
    const PacketMask<S> drawn = (x >= pixels.threshold) & (P(static_cast<S>(i)) < stop);
    const P raw = exp2(x);
    const P alpha = clamped_alpha(raw, alpha_max, drawn);
    const S* color = scratch.chunk.template color<D>(i);
    P shade(S(0));
    for (int c = 0; c < channels; ++c) shade += P(color[c]) * pixels.grad[c];
    const BlendGrad<P> grad = blend_vjp(raw, alpha, alpha_max, shade, behind);
    batch.p[batch.count] = grad.by_log_alpha;
    batch.weight[batch.count] = grad.weight;
    const Vec2<S> anchor = nearest_in_tile(frame, g.x, g.y);
    batch.dx[batch.count] = anchor.x - px, batch.dy[batch.count] = anchor.y - py;
    batch.index[batch.count] = i;
    if (++batch.count == kLanes) flush(layout, px, py, pixels, scratch);
  }
  flush(layout, px, py, pixels, scratch);
  pixels.behind = behind;
}

// Turns the moments of one entry about its anchor in the tile into the sums of its slot.
template <class S>
void write_moments(const Splats<S>& s, const TileFrame<S>& frame, const BlendGaussian<S>& g, const S* sum, S* to) {
  const double unscale = 1 / std::sqrt(0.5 * kLog2E);  // a BlendGaussian holds u, w, v times sqrt(log2(e) / 2)
  const double u = g.u * unscale, w = g.w * unscale, v = g.v * unscale;
  const Vec2<S> anchor = nearest_in_tile(frame, g.x, g.y), near = nearest_in_image(s, g.x, g.y);
  const Vec2<double> far{double(g.x) - anchor.x, double(g.y) - anchor.y};  // 0 where the centre is in the tile
  blend_sums(sum, u, w, v, far, {double(near.x) - anchor.x, double(near.y) - anchor.y}, to);
}

template <class S>
void store_chunk(const Splats<S>& s, const Layout& layout, const TileFrame<S>& frame, const Entries& entries,
                 int64_t begin, const Scratch<S>& scratch, S* slots) {
  const int fields = layout.fields(), packets = layout.packets();
  for (int i = 0; i < scratch.chunk.count; ++i) {
    S* to = slots + int64_t{entries.slots[begin + i]} * fields;
    const S* from = reinterpret_cast<const S*>(scratch.sums + i * packets);
    write_moments(s, frame, scratch.chunk.gaussians[i], from, to);
    for (int f = kBlendSums; f < fields; ++f) to[f] = from[f];
  }
}

template <class S, int D>
void tile_backward(const Splats<S>& s, const Layout& layout, const Entries& entries, const ImageGrads<S>& image,
                   int64_t tile, S* slots) {
  const TileFrame<S> frame = tile_frame(s, tile);
  const int64_t begin = entries.tile_offsets[tile], end = entries.tile_offsets[tile + 1];
  if (begin == end) return;
  std::array<BlockPixels<S>, kBlocks> pixels;
  for (int b = 0; b < kBlocks; ++b)
    if (frame.inside >> b & 1) pixels[b] = load_pixels(s, frame, b, image);
  Scratch<S> scratch;
  for (int64_t at = begin + (end - begin - 1) / kChunk * kChunk; at >= begin; at -= kChunk) {
    const int count = static_cast<int>(std::min<int64_t>(kChunk, end - at));
    const int32_t chunk_begin = static_cast<int32_t>(at - begin);
    load_chunk<D>(s, entries, frame, at, count, scratch.chunk);
    std::fill(scratch.sums, scratch.sums + count * layout.packets(), Packet<S>(S(0)));
    for (int b = 0; b < kBlocks; ++b) {
      if (!(frame.inside >> b & 1) || pixels[b].last <= chunk_begin) continue;
      const int listed = scratch.chunk.list_block(b, scratch.list);
      block_backward<S, D>(s, layout, frame, b, chunk_begin, listed, pixels[b], scratch);
    }
    store_chunk(s, layout, frame, entries, at, scratch, slots);
  }
}

template <class S, int D>
void all_tiles_backward(const Splats<S>& s, const Layout& layout, const Entries& entries, const ImageGrads<S>& image,
                        S* slots) {
  parallel_for(s.tiles(), 1, s.threads, [&](int64_t begin, int64_t end) {
    for (int64_t t = begin; t < end; ++t) tile_backward<S, D>(s, layout, entries, image, t, slots);
  });
}

template <class S>
void write_gaussian(const Splats<S>& s, int64_t row, const double* sum, const Layout& layout,
                    const SplatGrads<S>& out) {
  const S mean_x = s.means2d[2 * row], mean_y = s.means2d[2 * row + 1];
  const Vec2<S> near = nearest_in_image(s, mean_x, mean_y);
  const S* factor = s.factors + 3 * row;
  const BlendSplatGrad<S> grad = splat_grad<S>(sum, factor[0], factor[1], factor[2], s.opacities[row],
                                               {double(mean_x) - near.x, double(mean_y) - near.y});
  out.means2d[2 * row] = grad.mean.x, out.means2d[2 * row + 1] = grad.mean.y;
  out.factors[3 * row] = grad.u, out.factors[3 * row + 1] = grad.w, out.factors[3 * row + 2] = grad.v;
  out.opacities[row] = grad.opacity;
  const double* channels = sum + kBlendSums;
  for (int c = 0; c < layout.channels; ++c) out.colors[row * layout.channels + c] = static_cast<S>(channels[c]);
  if (out.probe == nullptr) return;
  out.probe[4 * row] = grad.mean.x, out.probe[4 * row + 1] = grad.mean.y;
  for (int k = 0; k < 2; ++k)
    out.probe[4 * row + 2 + k] = layout.absolute ? static_cast<S>(channels[layout.channels + k]) : S(0);
}

template <class S>
void sum_slots(const Splats<S>& s, const Layout& layout, const Entries& entries, const S* slots,
               const SplatGrads<S>& out) {
  const int fields = layout.fields();
  parallel_for(s.num_views * s.num_gaussians, 1024, s.threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      double sum[kMaxFields] = {};
      for (int64_t k = entries.slot_ranges[2 * i]; k < entries.slot_ranges[2 * i + 1]; ++k)
        for (int f = 0; f < fields; ++f) sum[f] += slots[k * fields + f];
      write_gaussian(s, i, sum, layout, out);
    }
  });
}

}  // namespace

template <class S>
void rasterize_backward(const Splats<S>& s, const Entries& entries, const ImageGrads<S>& image,
                        const SplatGrads<S>& out) {
  const Layout layout{s.channels, out.absolute};
  const auto slots = std::make_unique_for_overwrite<S[]>(static_cast<size_t>(entries.count) * layout.fields());
  switch (s.channels) {
    case 1: all_tiles_backward<S, 1>(s, layout, entries, image, slots.get()); break;
    case 3: all_tiles_backward<S, 3>(s, layout, entries, image, slots.get()); break;
    case 4: all_tiles_backward<S, 4>(s, layout, entries, image, slots.get()); break;
    default: all_tiles_backward<S, kDynamic>(s, layout, entries, image, slots.get());
  }
  sum_slots(s, layout, entries, slots.get(), out);
}

template void rasterize_backward<float>(const Splats<float>&, const Entries&, const ImageGrads<float>&,
                                        const SplatGrads<float>&);
template void rasterize_backward<double>(const Splats<double>&, const Entries&, const ImageGrads<double>&,
                                         const SplatGrads<double>&);

}  // namespace dyngs

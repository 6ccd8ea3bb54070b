// The weights of math/boundary.hpp at all pixels, for the rasterizer: each 4x4 block of pixels has a packet of weights for each
// patch that one of its pixels shows, or whose outline passes near one. All other patches have weight 0 there.
#pragma once

#include <array>
#include <vector>

#include "core/triangles.hpp"
#include "cpu/parallel.hpp"
#include "cpu/tile.hpp"
#include "math/boundary.hpp"

namespace dyngs {

// The patches of one block.
template <class S>
struct BlockBoundary {
  int count;
  const int32_t* patches;    // (count,)
  const Packet<S>* weights;  // (count,)
  Packet<S>* grads;          // (count,) sums of the gradient by log alpha

  // Where `patch` is in the lists; `count` if it is not.
  int find(int32_t patch) const {
    int at = 0;
    while (at < count && patches[at] != patch) ++at;
    return at;
  }
};

template <class S>
class BoundaryTable {
 public:
  BoundaryTable(const Boundaries<S>& in, int width, int height, int threads)
      : in_(in),
        width_(width),
        height_(height),
        columns_((width + kBlockSide - 1) / kBlockSide),
        rows_((height + kBlockSide - 1) / kBlockSide) {
    const std::vector<std::vector<int32_t>> samples = samples_of_rows();
    parallel_for(static_cast<int64_t>(rows_.size()), 1, threads, [&](int64_t begin, int64_t end) {
      for (int64_t row = begin; row < end; ++row) build_row(static_cast<int>(row), samples[row]);
    });
  }

  int32_t patch(int64_t gaussian) const { return in_.ids[gaussian]; }

  // The patches of all blocks of a tile that lie in the image.
  void load_tile(const TileFrame<S>& frame, BlockBoundary<S> (&blocks)[kBlocks]) {
    for (int b = 0; b < kBlocks; ++b) {
      blocks[b] = {};
      if (!(frame.inside >> b & 1)) continue;
      Row& row = rows_[frame.y0 / kBlockSide + b / 4];
      const int column = frame.x0 / kBlockSide + b % 4, first = row.starts[column];
      blocks[b] = {row.starts[column + 1] - first, row.patches.data() + first, row.weights.data() + first,
                   row.grads.data() + first};
    }
  }

  // Writes the gradients (N, 2) by the samples.
  void sample_grads(int64_t count, S* out) const {
    std::fill(out, out + 2 * count, S(0));
    for (size_t r = 0; r < rows_.size(); ++r) {
      for (int column = 0; column < columns_; ++column) {
        for (int at = rows_[r].starts[column]; at < rows_[r].starts[column + 1]; ++at)
          add_grads(rows_[r], at, column, static_cast<int>(r), out);
      }
    }
  }

 private:
  using Nearest = std::array<int32_t, kLanes>;  // sample of each pixel, -1: none within the radius

  struct Row {
    std::vector<int32_t> starts;  // (columns + 1)
    std::vector<int32_t> patches;
    std::vector<Packet<S>> weights, grads;
    std::vector<Nearest> nearest;
  };

  // A patch of a block while its row is built.
  struct Candidate {
    int32_t patch;
    int next;  // of the same block, -1: none
    Packet<S> squared;
    Nearest nearest;
  };

  struct Candidates {
    explicit Candidates(int columns) : first(columns, -1), last(columns, -1) {}

    Candidate& find(int column, int32_t patch) {
      for (int at = first[column]; at >= 0; at = all[at].next)
        if (all[at].patch == patch) return all[at];
      const int at = static_cast<int>(all.size());
      (first[column] < 0 ? first[column] : all[last[column]].next) = at;
      last[column] = at;
      Candidate& added = all.emplace_back();
      added.patch = patch, added.next = -1, added.squared = Packet<S>(kLargest<S>);
      added.nearest.fill(-1);
      return added;
    }

    std::vector<Candidate> all;
    std::vector<int> first, last;  // of each column
  };

  // The patch that a pixel shows, -1: nothing, or outside the image.
  int32_t shown(int x, int y) const {
    if (x < 0 || y < 0 || x >= width_ || y >= height_) return -1;
    const int32_t row = in_.rows[int64_t{y} * width_ + x];
    return row < 0 ? -1 : in_.ids[row];
  }

  // Whether one of the eight neighbours in the image shows another patch.
  bool on_outline(int x, int y) const {
    const int32_t own = shown(x, y);
    for (int v = std::max(y - 1, 0); v <= std::min(y + 1, height_ - 1); ++v) {
      for (int u = std::max(x - 1, 0); u <= std::min(x + 1, width_ - 1); ++u)
        if (shown(u, v) != own) return true;
    }
    return false;
  }

  // Integers [begin, end) whose centres may be within the radius.
  std::pair<int, int> around(S x, int size) const {
    const S low = clamp(x - in_.radius, S(0), static_cast<S>(size));
    const S high = clamp(x + in_.radius, S(0), static_cast<S>(size));
    return {static_cast<int>(low), std::min(static_cast<int>(high) + 1, size)};
  }

  // The samples of outlines near each row of blocks, in the order of their pixels.
  std::vector<std::vector<int32_t>> samples_of_rows() const {
    std::vector<std::vector<int32_t>> found(rows_.size());
    for (int y = 0; y < height_; ++y) {
      for (int x = 0; x < width_; ++x) {
        const int32_t n = in_.rows[int64_t{y} * width_ + x];
        if (n < 0 || !on_outline(x, y)) continue;
        const auto [begin, end] = around(in_.samples[2 * n + 1], height_);
        for (int row = begin / kBlockSide; row * kBlockSide < end; ++row) found[row].push_back(n);
      }
    }
    return found;
  }

  // Not inlined: two copies, for one thread and for several, could round differently.
  [[gnu::noinline]] void build_row(int row, const std::vector<int32_t>& samples) {
    using P = Packet<S>;
    Candidates found(columns_);
    const int y0 = row * kBlockSide;
    for (int y = y0; y < std::min(y0 + kBlockSide, height_); ++y) {
      int32_t before = -1;
      for (int x = 0; x < width_; ++x) {
        const int32_t patch = shown(x, y);
        if (patch >= 0 && (patch != before || x % kBlockSide == 0)) found.find(x / kBlockSide, patch);
        before = patch;
      }
    }
    const LaneOffsets<S> lane;
    const P limit(in_.radius * in_.radius);
    for (const int32_t n : samples) {
      const S x = in_.samples[2 * n], y = in_.samples[2 * n + 1];
      const P dy = P(y - (static_cast<S>(y0) + S(0.5))) - lane.y;
      const auto [left, right] = around(x, width_);
      for (int column = left / kBlockSide; column * kBlockSide < right; ++column) {
        const P dx = P(x - (static_cast<S>(column * kBlockSide) + S(0.5))) - lane.x;
        const P squared = dx * dx + dy * dy;
        const PacketMask<S> near = squared < limit;
        if (!any(near)) continue;
        Candidate& of = found.find(column, in_.ids[n]);
        const PacketMask<S> nearer = near & (squared < of.squared);
        of.squared = select(nearer, squared, of.squared);
        for (uint32_t bits = to_bits(nearer); bits != 0; bits &= bits - 1) of.nearest[__builtin_ctz(bits)] = n;
      }
    }
    pack(found, row);
  }

  void pack(const Candidates& found, int row) {
    Row& to = rows_[row];
    to.patches.reserve(found.all.size()), to.weights.reserve(found.all.size());
    to.nearest.reserve(found.all.size());
    to.starts.assign(1, 0);
    for (int column = 0; column < columns_; ++column) {
      int32_t patches[kLanes];
      for (int i = 0; i < kLanes; ++i) patches[i] = shown_at(column, row, i);
      for (int at = found.first[column]; at >= 0; at = found.all[at].next) {
        const Candidate& from = found.all[at];
        Packet<S> shows;
        for (int i = 0; i < kLanes; ++i) shows[i] = patches[i] == from.patch ? S(1) : S(0);
        const Packet<S> rho = sqrt(from.squared) / Packet<S>(in_.radius);
        to.patches.push_back(from.patch);
        to.weights.push_back(boundary_weight(rho, shows > Packet<S>(S(0))));
        to.nearest.push_back(from.nearest);
      }
      to.starts.push_back(static_cast<int32_t>(to.patches.size()));
    }
    to.grads.assign(to.patches.size(), Packet<S>(S(0)));
  }

  int32_t shown_at(int column, int row, int lane) const {
    return shown(column * kBlockSide + lane % kBlockSide, row * kBlockSide + lane / kBlockSide);
  }

  void add_grads(const Row& from, int at, int column, int row, S* out) const {
    for (int i = 0; i < kLanes; ++i) {
      const int32_t n = from.nearest[at][i];
      const S by_log_weight = from.grads[at][i];
      if (n < 0 || by_log_weight == S(0)) continue;
      const S dx = in_.samples[2 * n] - (static_cast<S>(column * kBlockSide + i % kBlockSide) + S(0.5));
      const S dy = in_.samples[2 * n + 1] - (static_cast<S>(row * kBlockSide + i / kBlockSide) + S(0.5));
      const S distance = sqrt(dx * dx + dy * dy);
      if (distance < S(kLeastOffset)) continue;
      const bool inside = shown_at(column, row, i) == from.patches[at];
      const S by_rho = by_log_weight * boundary_log_slope(from.weights[at][i], inside);
      const S grad = by_rho / (in_.radius * distance);
      out[2 * n] += grad * dx, out[2 * n + 1] += grad * dy;
    }
  }

  const Boundaries<S>& in_;
  int width_, height_, columns_;
  std::vector<Row> rows_;
};

}  // namespace dyngs

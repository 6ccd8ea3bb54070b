// The weights of math/boundary.hpp at all pixels, for the rasterizer: each 4x4 block of pixels has a packet of weights for each
// patch that one of its pixels shows, or whose outline passes near one. All other patches have weight 0 there.
#pragma once

#include <array>
#include <limits>
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
  const int32_t* owners;          // (count,) patches
  const Packet<S>* log2_weights;  // (count,)
  Packet<S>* grads;               // (count,) sums of the gradient by log alpha

  // Where `owner` is in the lists; `count` if it is not.
  int find(int32_t owner) const {
    int at = 0;
    while (at < count && owners[at] != owner) ++at;
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

  int32_t owner(int64_t gaussian) const { return in_.owners[gaussian]; }

  // The patches of all blocks of a tile that lie in the image.
  void load_tile(const TileFrame<S>& frame, BlockBoundary<S> (&blocks)[kBlocks]) {
    for (int b = 0; b < kBlocks; ++b) {
      blocks[b] = {};
      if (!(frame.inside >> b & 1)) continue;
      Row& row = rows_[frame.y0 / kBlockSide + b / 4];
      const int column = frame.x0 / kBlockSide + b % 4, first = row.starts[column];
      blocks[b] = {row.starts[column + 1] - first, row.owners.data() + first, row.log2_weights.data() + first,
                   row.grads.data() + first};
    }
  }

  // Writes the gradients (B, 2) by the samples.
  void sample_grads(S* out) const {
    std::fill(out, out + 2 * in_.count, S(0));
    for (size_t r = 0; r < rows_.size(); ++r) {
      for (int column = 0; column < columns_; ++column) {
        for (int at = rows_[r].starts[column]; at < rows_[r].starts[column + 1]; ++at)
          add_grads(rows_[r], at, column, static_cast<int>(r), out);
      }
    }
  }

 private:
  using Nearest = std::array<int32_t, kLanes>;

  struct Row {
    std::vector<int32_t> starts;  // (columns + 1)
    std::vector<int32_t> owners;
    std::vector<Packet<S>> log2_weights, grads;
    std::vector<Nearest> nearest;  // sample of each pixel, -1: none within the radius
  };

  // A patch of a block while its row is built.
  struct Candidate {
    int32_t owner;
    int next;  // of the same block, -1: none
    S squared[kLanes];
    Nearest nearest;
  };

  struct Candidates {
    explicit Candidates(int columns) : first(columns, -1), last(columns, -1) {}

    Candidate& find(int column, int32_t owner) {
      for (int at = first[column]; at >= 0; at = all[at].next)
        if (all[at].owner == owner) return all[at];
      const int at = static_cast<int>(all.size());
      (first[column] < 0 ? first[column] : all[last[column]].next) = at;
      last[column] = at;
      Candidate& added = all.emplace_back();
      added.owner = owner, added.next = -1;
      std::fill(added.squared, added.squared + kLanes, kLargest<S>);
      added.nearest.fill(-1);
      return added;
    }

    std::vector<Candidate> all;
    std::vector<int> first, last;
  };

  // Integers [begin, end) whose centres may be within the radius.
  std::pair<int, int> around(S x, int size) const {
    const S low = clamp(x - in_.radius, S(0), static_cast<S>(size));
    const S high = clamp(x + in_.radius, S(0), static_cast<S>(size));
    return {static_cast<int>(low), std::min(static_cast<int>(high) + 1, size)};
  }

  // The samples near each row of blocks, in their order.
  std::vector<std::vector<int32_t>> samples_of_rows() const {
    std::vector<std::vector<int32_t>> found(rows_.size());
    for (int64_t n = 0; n < in_.count; ++n) {
      const auto [begin, end] = around(in_.samples[2 * n + 1], height_);
      for (int row = begin / kBlockSide; row * kBlockSide < end; ++row) found[row].push_back(static_cast<int32_t>(n));
    }
    return found;
  }

  // Not inlined: two copies, for one thread and for several, could round differently.
  [[gnu::noinline]] void build_row(int row, const std::vector<int32_t>& samples) {
    Candidates found(columns_);
    const int y0 = row * kBlockSide, y1 = std::min(y0 + kBlockSide, height_);
    for (int y = y0; y < y1; ++y) {
      for (int x = 0; x < width_; ++x) {
        const int32_t shown = in_.shown[int64_t{y} * width_ + x];
        if (shown >= 0) found.find(x / kBlockSide, shown);
      }
    }
    for (const int32_t n : samples) {
      const auto [top, bottom] = around(in_.samples[2 * n + 1], height_);
      const auto [left, right] = around(in_.samples[2 * n], width_);
      for (int y = std::max(top, y0); y < std::min(bottom, y1); ++y) {
        for (int x = left; x < right; ++x) {
          const Vec2<S> offset = offset_from(n, x, y);
          const S squared = offset.x * offset.x + offset.y * offset.y;
          if (!(squared < in_.radius * in_.radius)) continue;
          Candidate& of = found.find(x / kBlockSide, in_.ids[n]);
          const int lane = (y - y0) * kBlockSide + x % kBlockSide;
          if (squared < of.squared[lane]) of.squared[lane] = squared, of.nearest[lane] = n;
        }
      }
    }
    pack(found, row);
  }

  void pack(const Candidates& found, int row) {
    Row& to = rows_[row];
    to.starts.assign(1, 0);
    for (int column = 0; column < columns_; ++column) {
      for (int at = found.first[column]; at >= 0; at = found.all[at].next) {
        const Candidate& from = found.all[at];
        Packet<S> weights;
        for (int i = 0; i < kLanes; ++i) {
          const bool inside = shows(column, row, i, from.owner);
          weights[i] = inside ? S(0) : -std::numeric_limits<S>::infinity();
          if (from.nearest[i] >= 0) weights[i] = log2_boundary_weight(sqrt(from.squared[i]) / in_.radius, inside);
        }
        to.owners.push_back(from.owner);
        to.log2_weights.push_back(weights);
        to.nearest.push_back(from.nearest);
      }
      to.starts.push_back(static_cast<int32_t>(to.owners.size()));
    }
    to.grads.assign(to.owners.size(), Packet<S>(S(0)));
  }

  bool shows(int column, int row, int lane, int32_t owner) const {
    const int x = column * kBlockSide + lane % kBlockSide, y = row * kBlockSide + lane / kBlockSide;
    return x < width_ && y < height_ && in_.shown[int64_t{y} * width_ + x] == owner;
  }

  // From a pixel's centre to a sample.
  Vec2<S> offset_from(int32_t sample, int x, int y) const {
    return {in_.samples[2 * sample] - (static_cast<S>(x) + S(0.5)),
            in_.samples[2 * sample + 1] - (static_cast<S>(y) + S(0.5))};
  }

  void add_grads(const Row& from, int at, int column, int row, S* out) const {
    for (int i = 0; i < kLanes; ++i) {
      const int32_t n = from.nearest[at][i];
      const S by_log_weight = from.grads[at][i];
      if (n < 0 || by_log_weight == S(0)) continue;
      const Vec2<S> offset =
          offset_from(n, column * kBlockSide + i % kBlockSide, row * kBlockSide + i / kBlockSide);
      const S distance = sqrt(offset.x * offset.x + offset.y * offset.y);
      if (distance < S(kLeastOffset)) continue;
      const bool inside = shows(column, row, i, from.owners[at]);
      const S slope = log2_boundary_slope(distance / in_.radius, inside) / S(kLog2E);
      const S grad = by_log_weight * slope / (in_.radius * distance);
      out[2 * n] += grad * offset.x, out[2 * n + 1] += grad * offset.y;
    }
  }

  const Boundaries<S>& in_;
  int width_, height_, columns_;
  std::vector<Row> rows_;
};

}  // namespace dyngs

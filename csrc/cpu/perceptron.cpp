// Small multilayer perceptron, forward and backward, a block of rows at a time so that all its activations stay in the
// second-level cache.
//
// With H_l the (n, in) input of layer l, Z_l = H_l W_l^T + b_l and G_l = d loss / d Z_l, the three products
//   Z_l = H_l W_l^T,   d H_l = G_l W_l,   d W_l = G_l^T H_l
// run through one register-blocked kernel: rows of scalars from the left factor, lanes of columns from the right one.
// The weights, as right factors, are packed once per call into panels as wide as the kernel's tile.
//
// Sums have a fixed order: within a block the kernel's, from block to block in order of the rows within one of kParts
// ranges of blocks, then over these ranges in order.
#include "core/api.hpp"

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstring>
#include <memory>
#include <new>
#include <utility>
#if defined(__linux__)
#include <sys/mman.h>
#endif

#include "cpu/parallel.hpp"
#include "cpu/simd.hpp"

namespace dyngs {
namespace {

constexpr int64_t kBlock = 96;  // rows
constexpr int64_t kParts = 16;  // ranges of blocks with their own sum of parameter gradients
constexpr int64_t kPad = 16;    // widths are padded to a multiple of it, the lanes of the widest vector of floats

#if defined(__AVX512F__)
constexpr int kMaxVectors = 4;  // columns of a tile, in vectors; with kTileRows this fills 32 registers
constexpr int kTileRows[] = {8, 8, 8, 6};
#elif defined(__AVX__)
constexpr int kMaxVectors = 2;  // 16 registers
constexpr int kTileRows[] = {8, 6};
#else
constexpr int kMaxVectors = 2;
constexpr int kTileRows[] = {8, 6};
#endif
constexpr int kMaxRows = 8;

constexpr int64_t padded(int64_t width) { return (width + kPad - 1) / kPad * kPad; }
// Distance of rows in memory. One more cache line than needed, or else rows of 2^n would share few sets of the cache.
constexpr int64_t stride_of(int64_t width) { return padded(width) + kPad; }

// Columns [begin, end) of panel p, in vectors: as few panels as the tile allows, of equal width up to one vector.
struct Panels {
  int64_t vectors, count;
  explicit Panels(int64_t columns, int64_t lanes)
      : vectors((columns + lanes - 1) / lanes), count((vectors + kMaxVectors - 1) / kMaxVectors) {}
  int64_t begin(int64_t p) const { return vectors * p / count; }
};

enum class After { kNothing, kRelu, kGate };

// C (rows, columns) = start + A B, then `after`. C, start and gate have columns padded to whole vectors.
template <class S>
struct Product {
  int64_t rows, depth, columns;
  const S* a;  // (rows, depth), or (depth, rows) for the transposed product
  int64_t a_stride;
  const S* b;  // packed panels, or (depth, columns) if b_stride is not 0
  int64_t b_stride;
  const S* start;
  int64_t start_stride;
  S* c;
  int64_t c_stride;
  After after;
  const S* gate = nullptr;  // (rows, columns): kGate puts zeros where it is not positive, the gradient of a ReLU
  int64_t gate_stride = 0;
};

template <int kRows, int kVectors, bool kTransposed, class S>
void tile(const Product<S>& in, int64_t row, int64_t column, const S* b, int64_t b_stride) {
  constexpr int64_t kLanes = Native<S>::kSize;
  Native<S> sum[kRows][kVectors];
  const S* start = in.start + row * in.start_stride + column;
  for (int r = 0; r < kRows; ++r)
    for (int v = 0; v < kVectors; ++v) sum[r][v] = load_native(start + r * in.start_stride + v * kLanes);
  const int64_t row_step = kTransposed ? 1 : in.a_stride, step = kTransposed ? in.a_stride : 1;
  const S* a = in.a + row * row_step;
  for (int64_t k = 0; k < in.depth; ++k, a += step, b += b_stride) {
    Native<S> right[kVectors];
    for (int v = 0; v < kVectors; ++v) right[v] = load_native(b + v * kLanes);
    for (int r = 0; r < kRows; ++r) {
      const Native<S> left(a[r * row_step]);
      for (int v = 0; v < kVectors; ++v) sum[r][v] += left * right[v];
    }
  }
  const Native<S> zero(S(0));
  if (in.after == After::kRelu) {
    for (int r = 0; r < kRows; ++r)
      for (int v = 0; v < kVectors; ++v) sum[r][v] = max(zero, sum[r][v]);  // lets NaN through
  } else if (in.after == After::kGate) {
    const S* gate = in.gate + row * in.gate_stride + column;
    for (int r = 0; r < kRows; ++r)
      for (int v = 0; v < kVectors; ++v)
        sum[r][v] = select(load_native(gate + r * in.gate_stride + v * kLanes) <= zero, zero, sum[r][v]);
  }
  S* c = in.c + row * in.c_stride + column;
  for (int r = 0; r < kRows; ++r)
    for (int v = 0; v < kVectors; ++v) store(c + r * in.c_stride + v * kLanes, sum[r][v]);
}

template <class S>
using Tile = void (*)(const Product<S>&, int64_t, int64_t, const S*, int64_t);

// tiles[v - 1][r - 1] is the tile of r rows and v vectors.
template <bool kTransposed, class S>
constexpr auto all_tiles() {
  return []<size_t... V>(std::index_sequence<V...>) {
    return std::array{[]<size_t kV, size_t... R>(std::integral_constant<size_t, kV>, std::index_sequence<R...>) {
      return std::array<Tile<S>, kMaxRows>{tile<R + 1, kV, kTransposed, S>...};
    }(std::integral_constant<size_t, V + 1>(), std::make_index_sequence<kTileRows[V]>())...};
  }(std::make_index_sequence<kMaxVectors>());
}

template <bool kTransposed, class S>
void multiply(const Product<S>& in) {
  static constexpr auto tiles = all_tiles<kTransposed, S>();
  constexpr int64_t kLanes = Native<S>::kSize;
  const Panels panels(in.columns, kLanes);
  for (int64_t p = 0; p < panels.count; ++p) {
    const int64_t column = panels.begin(p) * kLanes, vectors = panels.begin(p + 1) - panels.begin(p);
    const S* b = in.b_stride == 0 ? in.b + column * in.depth : in.b + column;
    const int64_t b_stride = in.b_stride == 0 ? vectors * kLanes : in.b_stride;
    const int64_t most = kTileRows[vectors - 1], steps = (in.rows + most - 1) / most;
    for (int64_t t = 0, row = 0; t < steps; ++t) {
      const int64_t end = in.rows * (t + 1) / steps;
      tiles[vectors - 1][end - row - 1](in, row, column, b, b_stride);
      row = end;
    }
  }
}

// The right factor B (depth, columns), B(k, c) = from[k * k_stride + c * c_stride], as panels with zeros in the padding.
template <class S>
void pack(const S* from, int64_t depth, int64_t columns, int64_t k_stride, int64_t c_stride, S* to) {
  constexpr int64_t kLanes = Native<S>::kSize;
  const Panels panels(columns, kLanes);
  for (int64_t p = 0; p < panels.count; ++p) {
    const int64_t begin = panels.begin(p) * kLanes, end = panels.begin(p + 1) * kLanes;
    for (int64_t k = 0; k < depth; ++k)
      for (int64_t c = begin; c < end; ++c) *to++ = c < columns ? from[k * k_stride + c * c_stride] : S(0);
  }
}

template <class S>
class Buffer {
 public:
  explicit Buffer(int64_t size) : data_(static_cast<S*>(operator new(size * sizeof(S), kAlignment))) {}
  S* get() { return data_.get(); }
  S* take(int64_t size) {
    S* from = data_.get() + used_;
    used_ += size;
    return from;
  }

 private:
  static constexpr std::align_val_t kAlignment{64};
  struct Delete {
    void operator()(S* data) const { operator delete(data, kAlignment); }
  };
  std::unique_ptr<S, Delete> data_;
  int64_t used_ = 0;
};

// A layer's packed weights, and the offsets of its parts in the buffers.
template <class S>
struct Layer {
  int64_t hidden, in, out;
  const S* forward;       // W^T: (in, out)
  const S* bias;          // padded
  const S* to_hidden;     // W[:, :hidden], backward only
  const S* to_input;      // W[:, hidden:], backward only and of the skip layer only
  int64_t kept_offset;    // its input within a block's kept scalars, per row; that of the first layer is not kept
  int64_t weight_offset;  // its weight gradient within a part's sums: (out, stride_of(in))
  int64_t bias_offset;    // (padded(out),)
};

// A network with its weights packed.
template <class S>
class Plan {
 public:
  Plan(const Perceptron<S>& net, bool backward) : packed_(packed_size(net, backward)), input_(net.widths[0]) {
    const S* from = net.params;
    for (int64_t l = 0; l < net.layers(); ++l) {
      Layer<S> layer{};
      layer.hidden = net.hidden(l), layer.in = net.in(l), layer.out = net.out(l);
      S* to = packed_.take(layer.in * padded(layer.out));
      pack(from, layer.in, layer.out, 1, layer.in, to);
      layer.forward = to;
      layer.bias = to = packed_.take(padded(layer.out));
      std::fill(std::copy_n(from + layer.out * layer.in, layer.out, to), to + padded(layer.out), S(0));
      if (backward) {
        layer.to_hidden = to = packed_.take(layer.out * padded(layer.hidden));
        pack(from, layer.out, layer.hidden, layer.in, 1, to);
        layer.to_input = to = packed_.take(layer.out * padded(layer.in - layer.hidden));
        pack(from + layer.hidden, layer.out, layer.in - layer.hidden, layer.in, 1, to);
      }
      layer.kept_offset = kept_, layer.weight_offset = sums_,
      layer.bias_offset = sums_ + layer.out * stride_of(layer.in);
      kept_ += l == 0 ? 0 : stride_of(layer.in), sums_ = layer.bias_offset + padded(layer.out);
      widest_ = std::max({widest_, layer.in, layer.out});
      from += layer.out * (layer.in + 1);
      layers.push_back(layer);
    }
    zeros_.assign(padded(widest_), S(0));
  }

  int64_t input() const { return input_; }
  int64_t kept() const { return kept_; }                 // scalars per row
  int64_t sums() const { return sums_; }                 // scalars of one part's parameter gradients
  int64_t stride() const { return stride_of(widest_); }  // of any layer's input or output
  const S* zeros() const { return zeros_.data(); }

  std::vector<Layer<S>> layers;

 private:
  static int64_t packed_size(const Perceptron<S>& net, bool backward) {
    int64_t size = 0;
    for (int64_t l = 0; l < net.layers(); ++l) {
      size += (net.in(l) + 1) * padded(net.out(l));
      if (backward) size += net.out(l) * (padded(net.hidden(l)) + padded(net.in(l) - net.hidden(l)));
    }
    return size;
  }

  Buffer<S> packed_;
  std::vector<S> zeros_;
  int64_t input_, kept_ = 0, sums_ = 0, widest_ = 0;
};

// Copies the first `width` columns, and writes zeros from there to the column `end`.
template <class S>
void copy_rows(const S* from, int64_t rows, int64_t width, int64_t from_stride, S* to, int64_t to_stride, int64_t end) {
  for (int64_t r = 0; r < rows; ++r)
    std::fill(std::copy_n(from + r * from_stride, width, to + r * to_stride), to + r * to_stride + end, S(0));
}

// Rows without padding into padded rows.
template <class S>
void pad_rows(const S* from, int64_t rows, int64_t width, S* to) {
  copy_rows(from, rows, width, width, to, stride_of(width), stride_of(width));
}

// Padded rows into rows without padding.
template <class S>
void unpad_rows(const S* from, int64_t rows, int64_t width, S* to) {
  copy_rows(from, rows, width, stride_of(width), to, width, width);
}

// Runs a block through all layers but the last, and through the last too if `last` is given, for its output. x is padded.
// The inputs of the other layers land in `inputs`: all of them as kept for the backward pass, or else only the last two.
template <class S>
void run_block(const Plan<S>& plan, int64_t rows, const S* x, S* inputs, bool keep, S* last) {
  const auto place = [&](size_t l) {
    return inputs + rows * (keep ? plan.layers[l].kept_offset : l % 2 * plan.stride());
  };
  const S* from = x;
  for (size_t l = 0; l < plan.layers.size(); ++l) {
    const Layer<S>& layer = plan.layers[l];
    const bool is_last = l + 1 == plan.layers.size();
    if (is_last && last == nullptr) return;
    const int64_t next_in = is_last ? layer.out : plan.layers[l + 1].in, stride = stride_of(next_in);
    S* to = is_last ? last : place(l + 1);
    multiply<false>(Product<S>{rows, layer.in, layer.out, from, stride_of(layer.in), layer.forward, 0, layer.bias, 0,
                               to, stride, is_last ? After::kNothing : After::kRelu});
    if (next_in > layer.out)
      copy_rows(x, rows, plan.input(), stride_of(plan.input()), to + layer.out, stride, stride - layer.out);
    from = to;
  }
}

// sums[c] += the sum over rows of from[r][c].
template <class S>
void add_columns(const S* from, int64_t rows, int64_t columns, int64_t stride, S* sums) {
  for (int64_t c = 0; c < columns; c += Native<S>::kSize) {
    Native<S> sum = load_native(sums + c);
    for (int64_t r = 0; r < rows; ++r) sum += load_native(from + r * stride + c);
    store(sums + c, sum);
  }
}

// Scratch memory of one thread in the forward pass.
template <class S>
struct Rows {
  Buffer<S> x, last, inputs;  // padded; the last two layers' inputs, unless all are kept
  Rows(const Plan<S>& plan, bool kept)
      : x(kBlock * stride_of(plan.input())),
        last(kBlock * stride_of(plan.layers.back().out)),
        inputs(kept ? 0 : 2 * kBlock * plan.stride()) {}
};

// And in the backward pass. x and grad_x are padded.
template <class S>
struct Scratch {
  Buffer<S> x, kept, grad, next_grad, grad_x;
  Scratch(const Plan<S>& plan, bool with_kept)
      : x(kBlock * stride_of(plan.input())),
        kept(with_kept ? kBlock * plan.kept() : 0),
        grad(kBlock * plan.stride()),
        next_grad(kBlock * plan.stride()),
        grad_x(kBlock * stride_of(plan.input())) {}
};

// Adds a block's parameter gradients to `sums`, and leaves its gradient by scratch.x in scratch.grad_x if asked for.
template <class S>
void backward_block(const Plan<S>& plan, int64_t rows, const S* kept, const S* grad_y, bool with_x, Scratch<S>& scratch,
                    S* sums) {
  const int64_t x_stride = stride_of(plan.input());
  S *grad = scratch.grad.get(), *next = scratch.next_grad.get(), *grad_x = scratch.grad_x.get();
  if (with_x) std::fill_n(grad_x, rows * x_stride, S(0));
  const auto add_to_x = [&](const Layer<S>& layer, const S* weight) {
    multiply<false>(Product<S>{rows, layer.out, plan.input(), grad, stride_of(layer.out), weight, 0, grad_x, x_stride,
                               grad_x, x_stride, After::kNothing});
  };
  const int64_t last_out = plan.layers.back().out;
  pad_rows(grad_y, rows, last_out, grad);
  for (size_t l = plan.layers.size(); l-- > 0;) {
    const Layer<S>& layer = plan.layers[l];
    const S* input = l == 0 ? scratch.x.get() : kept + rows * layer.kept_offset;
    const int64_t stride = stride_of(layer.out), in_stride = stride_of(layer.in);
    S* weight = sums + layer.weight_offset;
    multiply<true>(Product<S>{layer.out, rows, layer.in, grad, stride, input, in_stride, weight, in_stride, weight,
                              in_stride, After::kNothing});
    add_columns(grad, rows, layer.out, stride, sums + layer.bias_offset);
    if (with_x && layer.in > layer.hidden) add_to_x(layer, layer.to_input);
    if (with_x && l == 0) add_to_x(layer, layer.to_hidden);
    if (l == 0) return;
    multiply<false>(Product<S>{rows, layer.out, layer.hidden, grad, stride, layer.to_hidden, 0, plan.zeros(), 0, next,
                               stride_of(layer.hidden), After::kGate, input, in_stride});
    std::swap(grad, next);
  }
}

// Asks for large pages for memory about to be filled: where the allocator has just mapped it, its small pages take longer to
// appear than the network to run. Only advice, so failure does not matter.
inline void prefer_large_pages(void* data, size_t bytes) {
#if defined(__linux__)
  constexpr uintptr_t kLargePage = uintptr_t(1) << 21;
  const uintptr_t address = reinterpret_cast<uintptr_t>(data), skip = (kLargePage - address % kLargePage) % kLargePage;
  if (bytes < skip + kLargePage) return;
  madvise(static_cast<char*>(data) + skip, (bytes - skip) / kLargePage * kLargePage, MADV_HUGEPAGE);
#else
  (void)data, (void)bytes;
#endif
}

// Sums the parts in order and writes them without padding.
template <class S>
void sum_parts(const Plan<S>& plan, const S* sums, int64_t parts, int threads, S* grad_params) {
  const auto total = [&](int64_t at) {
    S sum = S(0);
    for (int64_t p = 0; p < parts; ++p) sum += sums[p * plan.sums() + at];
    return sum;
  };
  for (const Layer<S>& layer : plan.layers) {
    parallel_for(layer.out, 16, threads, [&](int64_t begin, int64_t end) {
      for (int64_t o = begin; o < end; ++o)
        for (int64_t i = 0; i < layer.in; ++i)
          grad_params[o * layer.in + i] = total(layer.weight_offset + o * stride_of(layer.in) + i);
    });
    grad_params += layer.out * layer.in;
    for (int64_t o = 0; o < layer.out; ++o) *grad_params++ = total(layer.bias_offset + o);
  }
}

}  // namespace

template <class S>
int64_t Perceptron<S>::kept_per_row() const {
  int64_t count = 0;
  for (int64_t l = 1; l < layers(); ++l) count += stride_of(in(l));
  return count;
}

template <class S>
void perceptron_forward(const Perceptron<S>& net, int64_t rows, const S* x, S* y, S* kept) {
  const Plan<S> plan(net, false);
  const int64_t in = plan.input(), out = plan.layers.back().out;
  const int64_t blocks = (rows + kBlock - 1) / kBlock, grain = kBlock * std::max<int64_t>(1, blocks / (4 * kParts));
  if (kept != nullptr) prefer_large_pages(kept, rows * plan.kept() * sizeof(S));
  const auto scratch = for_each_worker<Rows<S>>(net.threads, plan, kept != nullptr);
  parallel_workers(rows, grain, net.threads, [&](int worker, int64_t begin, int64_t end) {
    S *padded_x = scratch[worker]->x.get(), *last = scratch[worker]->last.get();
    for (int64_t from = begin; from < end; from += kBlock) {
      const int64_t count = std::min(kBlock, end - from);
      pad_rows(x + from * in, count, in, padded_x);
      run_block<S>(plan, count, padded_x, kept ? kept + from * plan.kept() : scratch[worker]->inputs.get(),
                   kept != nullptr, last);
      unpad_rows(last, count, out, y + from * out);
    }
  });
}

template <class S>
void perceptron_backward(const Perceptron<S>& net, int64_t rows, const S* x, const S* grad_y, const S* kept, S* grad_x,
                         S* grad_params) {
  const Plan<S> plan(net, true);
  const int64_t in = plan.input(), out = plan.layers.back().out;
  const int64_t blocks = (rows + kBlock - 1) / kBlock, parts = std::min(kParts, blocks);
  Buffer<S> sums(parts * plan.sums());
  const auto all_scratch = for_each_worker<Scratch<S>>(net.threads, plan, kept == nullptr);
  parallel_workers(parts, 1, net.threads, [&](int worker, int64_t part, int64_t) {
    Scratch<S>& scratch = *all_scratch[worker];
    S* part_sums = sums.get() + part * plan.sums();
    std::fill_n(part_sums, plan.sums(), S(0));
    const int64_t end = std::min(rows, blocks * (part + 1) / parts * kBlock);
    for (int64_t from = blocks * part / parts * kBlock; from < end; from += kBlock) {
      const int64_t count = std::min(kBlock, end - from);
      pad_rows(x + from * in, count, in, scratch.x.get());
      if (kept == nullptr) run_block<S>(plan, count, scratch.x.get(), scratch.kept.get(), true, nullptr);
      backward_block(plan, count, kept ? kept + from * plan.kept() : scratch.kept.get(), grad_y + from * out,
                     grad_x != nullptr, scratch, part_sums);
      if (grad_x != nullptr) unpad_rows(scratch.grad_x.get(), count, in, grad_x + from * in);
    }
  });
  sum_parts(plan, sums.get(), parts, net.threads, grad_params);
}

#define DYNGS_INSTANTIATE(S)                                                            \
  template struct Perceptron<S>;                                                        \
  template void perceptron_forward<S>(const Perceptron<S>&, int64_t, const S*, S*, S*); \
  template void perceptron_backward<S>(const Perceptron<S>&, int64_t, const S*, const S*, const S*, S*, S*);
DYNGS_INSTANTIATE(float)
DYNGS_INSTANTIATE(double)
#undef DYNGS_INSTANTIATE

}  // namespace dyngs

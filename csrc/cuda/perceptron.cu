// Small multilayer perceptron (core/api.hpp). A block takes a tile of rows through all layers, with activations in shared memory
// as [feature][row], so that a thread multiplies 4 rows by 8 columns of weights, which were padded and packed before. Backward,
// a block does so again, leaves the tile's activations in the workspace, and goes back through the layers, where it leaves the
// gradients by all outputs; then blocks of 32x32 weights sum over tiles, each over every k-th one, and a last kernel adds
// these sums in order: no atomics, the same bytes every time. Rows are taken some at a time, so that the workspace stays small.
//
// Limits, H100 (3.35 TB/s, L2 cache about 5.5 TB/s, 67 TFLOP/s in float32), per row. Operations: 2 per weight forward, 6
// backward (forward again, by inputs, by weights). The L2 cache gives the weights once per tile, and backward what is kept.
//   colours 14-32-32-3, tiles of 128 rows: forward 3.1 kflop, 47 ps, and 68 bytes, 20 ps: bound by operations; backward
//     9.4 kflop, 0.14 ns, and 1.7 kB of the L2 cache, 0.32 ns
//   grids 64-64-10, 64 rows: forward 9.5 kflop, 0.14 ns, 0.3 kB, 0.09 ns; backward 28 kflop, 0.42 ns, 3.2 kB of L2, 0.59 ns
//   places and time 76-256x8-10, 16 rows, all that fit 48 KiB: forward 1.0 Mflop, 15 ns, and 126 kB of weights from L2, 23 ns;
//     backward 3.0 Mflop, 45 ns, and 405 kB of L2, 74 ns
// Tensor cores (TF32, 495 TFLOP/s, 10 bits of mantissa) are not used. They could halve the first two's time forward and do
// nothing for it backward; the third they could do in a fifth of the time, but only with larger tiles, as L2 binds it here.
#include <algorithm>

#include "cuda/api.hpp"
#include "cuda/device.hpp"
#include "math/scalar.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 128;
constexpr int kColumns = 8;                        // of a thread; widths are padded to a multiple
constexpr int kMostGroups = 32, kLeastGroups = 2;  // of 4 rows in a tile
constexpr int kShared = 48 << 10;                  // bytes that every GPU grants
constexpr int kSide = 32, kSideThreads = 8;        // of the blocks of weights
constexpr int kPiece = 4;                          // groups of rows that such a block takes at a time
constexpr int kBlocks = 2112;                      // of weights and their sums: 16 per multiprocessor of an H100
constexpr int kMostSums = 512;
constexpr int kSlices = 8;

struct alignas(16) Four {
  float v[4];
};
using Fours = Array<const Four>;

struct LayerPlace {
  int hidden, extra, out;              // columns: of the layer before, of x beside them, of its output
  int forward, bias, to_hidden, to_x;  // its packed weights, in Fours; for products with (in, out), and back
  int input, grad;                     // features of a tile: the layer before, the gradient by its output
  int params, block;                   // its first parameter, and its first block of weights
};

// A network, where its parts lie in memory, and how rows are cut.
struct Net {
  LayerPlace layers[kPerceptronLayers];
  int count, skip, inputs;
  int packed;    // Fours
  int features;  // of a tile
  int odd, x;    // shared memory, in features: activations after layers 0, 2, ..., and x; the others begin it
  int shared_bytes;
  int groups;
  int params, blocks;
};

struct Rows {
  const float *x, *grad_y;
  float *y, *grad_x;
  int64_t first, end;  // of the launch
};

DYNGS_HD constexpr int padded(int width) { return (width + kColumns - 1) / kColumns * kColumns; }

// Packing -------------------------------------------------------------------------------------------------------------

// The packed number `at`: what is left of a layer's weights is in order, with zeros in the padding.
__device__ float packed_number(const Net& net, const float* params, int at) {
  int l = 0;
  while (l + 1 < net.count && at >= 4 * net.layers[l + 1].forward) ++l;
  const LayerPlace& p = net.layers[l];
  const int in = p.hidden + p.extra;
  const Array<const float> weight = global(params) + p.params;
  if (at < 4 * p.bias) {
    const int k = (at - 4 * p.forward) / padded(p.out), c = (at - 4 * p.forward) % padded(p.out);
    return c < p.out ? float{weight[c * in + k]} : 0.f;
  }
  if (at < 4 * p.to_hidden) {
    const int c = at - 4 * p.bias;
    return c < p.out ? float{weight[p.out * in + c]} : 0.f;
  }
  const bool to_x = at >= 4 * p.to_x;
  const int columns = to_x ? p.extra : p.hidden, from = at - 4 * (to_x ? p.to_x : p.to_hidden);
  const int k = from / padded(columns), c = from % padded(columns);
  return c < columns ? float{weight[k * in + (to_x ? p.hidden : 0) + c]} : 0.f;
}

__global__ void __launch_bounds__(kThreads) pack_weights_kernel(Net net, const float* params, Four* packed) {
  const int at = static_cast<int>(blockIdx.x) * kThreads + static_cast<int>(threadIdx.x);
  if (at >= net.packed) return;
  Four four;
  DYNGS_UNROLL
  for (int k = 0; k < 4; ++k) four.v[k] = packed_number(net, params, 4 * at + k);
  global(packed)[at] = four;
}

// Tiles of rows -------------------------------------------------------------------------------------------------------

// sum[column][row] += rows (depth, 4) times weights (depth, 8), which are `step` Fours apart.
__device__ __forceinline__ void add_product(const Fours& rows, int stride, int depth, const Fours& weights, int step,
                                            float (&sum)[kColumns][4]) {
  DYNGS_UNROLL_BY_4
  for (int k = 0; k < depth; ++k) {
    const Four row = rows[k * stride], low = weights[k * step], high = weights[k * step + 1];
    DYNGS_UNROLL
    for (int c = 0; c < 4; ++c) {
      DYNGS_UNROLL
      for (int r = 0; r < 4; ++r) sum[c][r] += row.v[r] * low.v[c], sum[4 + c][r] += row.v[r] * high.v[c];
    }
  }
}

// One block's tile: its shared memory, and its rows of all arrays. Every method is for all threads of the block; a thread has
// the same rows and columns of an array in all of them.
struct Tile {
  const Net& net;
  const Rows& rows;
  Array<Four> shared;
  Fours packed;
  Array<Four> kept;  // (features, groups), or null
  int64_t first;

  __device__ int stride() const { return net.groups + 1; }  // one more, or else features would share banks
  // Activations after i layers, or the gradients by them.
  __device__ Array<Four> place(int i) const { return shared + stride() * (i == 0 ? net.x : i % 2 != 0 ? net.odd : 0); }
  // Calls body(group, first column) for the thread's parts of an array with so many columns.
  template <class Body>
  __device__ __forceinline__ void for_each_part(int columns, const Body& body) const {
    const int parts = net.groups * (padded(columns) / kColumns);
    for (int part = static_cast<int>(threadIdx.x); part < parts; part += kThreads)
      body(part % net.groups, part / net.groups * kColumns);
  }
  __device__ bool is_row(int group, int r) const { return first + 4 * group + r < rows.end; }

  // Rows of global memory, zeros after the last one, to place(i) and to the tile's features from `feature` on.
  __device__ void load(const float* from, int width, int i, int feature) const {
    const Array<Four> to = place(i);
    for (int item = static_cast<int>(threadIdx.x); item < net.groups * width; item += kThreads) {
      const int c = item % width, group = item / width;
      Four four;
      DYNGS_UNROLL
      for (int r = 0; r < 4; ++r)
        four.v[r] = is_row(group, r) ? float{global(from)[(first + 4 * group + r) * width + c]} : 0.f;
      to[c * stride() + group] = four;
      if (kept) kept[(feature + c) * net.groups + group] = four;
    }
  }
  __device__ void store(const float (&sum)[kColumns][4], int i, int feature, int group, int column) const {
    const Array<Four> to = place(i) + column * stride() + group;
    DYNGS_UNROLL
    for (int c = 0; c < kColumns; ++c) {
      Four four;
      DYNGS_UNROLL
      for (int r = 0; r < 4; ++r) four.v[r] = is_row(group, r) ? sum[c][r] : 0.f;
      to[c * stride()] = four;
      if (kept) kept[(feature + column + c) * net.groups + group] = four;
    }
  }
  // To rows of global memory, or added to what is there.
  __device__ void write(const float (&sum)[kColumns][4], float* to, int width, bool add, int group, int column) const {
    DYNGS_UNROLL
    for (int r = 0; r < 4; ++r) {
      DYNGS_UNROLL
      for (int c = 0; c < kColumns; ++c) {
        if (!is_row(group, r) || column + c >= width) continue;
        const int64_t at = (first + 4 * group + r) * width + column + c;
        global(to)[at] = add ? global(to)[at] + sum[c][r] : sum[c][r];
      }
    }
  }

  __device__ void forward(int l) const {
    const LayerPlace& p = net.layers[l];
    const int step = padded(p.out) / 4;
    for_each_part(p.out, [&](int group, int column) {
      const Fours weights = packed + p.forward + column / 4;
      const Four low = packed[p.bias + column / 4], high = packed[p.bias + column / 4 + 1];
      float sum[kColumns][4];
      DYNGS_UNROLL
      for (int c = 0; c < 16; ++c) sum[c / 4][c % 4] = low.v[c / 4], sum[4 + c / 4][c % 4] = high.v[c / 4];
      add_product(place(l) + group, stride(), p.hidden, weights, step, sum);
      if (p.extra > 0) add_product(place(0) + group, stride(), p.extra, weights + p.hidden * step, step, sum);
      if (l + 1 == net.count) {
        write(sum, rows.y, p.out, false, group, column);
        return;
      }
      DYNGS_UNROLL
      for (int c = 0; c < 4 * kColumns; ++c) sum[c / 4][c % 4] = sum[c / 4][c % 4] <= 0.f ? 0.f : sum[c / 4][c % 4];
      store(sum, l + 1, net.layers[l + 1].input, group, column);  // NaN got through
    });
    __syncthreads();
  }

  // The gradient by x through the weights at `from` of layer l.
  __device__ void back_to_x(int l, int from, bool add) const {
    for_each_part(net.inputs, [&](int group, int column) {
      float sum[kColumns][4] = {};
      add_product(place(l + 1) + group, stride(), net.layers[l].out, packed + from + column / 4, padded(net.inputs) / 4,
                  sum);
      write(sum, rows.grad_x, net.inputs, add, group, column);
    });
  }
  __device__ void back_to_hidden(int l) const {
    const LayerPlace& p = net.layers[l];
    for_each_part(p.hidden, [&](int group, int column) {
      float sum[kColumns][4] = {};
      add_product(place(l + 1) + group, stride(), p.out, packed + p.to_hidden + column / 4, padded(p.hidden) / 4, sum);
      DYNGS_UNROLL
      for (int c = 0; c < kColumns; ++c) {
        const Four gate = kept[(p.input + column + c) * net.groups + group];
        DYNGS_UNROLL
        for (int r = 0; r < 4; ++r) sum[c][r] = gate.v[r] <= 0.f ? 0.f : sum[c][r];
      }
      store(sum, l, net.layers[l - 1].grad, group, column);
    });
    __syncthreads();
  }
};

__global__ void __launch_bounds__(kThreads) perceptron_kernel(Net net, Rows rows, const Four* packed) {
  DYNGS_DYNAMIC_SHARED(Four, shared);
  const Tile tile{net, rows, shared, global(packed), {}, int64_t{blockIdx.x} * 4 * net.groups};
  tile.load(rows.x, net.inputs, 0, 0);
  __syncthreads();
  for (int l = 0; l < net.count; ++l) tile.forward(l);
}

// Leaves x, all activations and the gradients by all outputs in `kept` (tiles, features, groups).
__global__ void __launch_bounds__(kThreads)
    perceptron_backward_kernel(Net net, Rows rows, const Four* packed, Four* kept) {
  DYNGS_DYNAMIC_SHARED(Four, shared);
  const Array<Four> mine = global(kept) + int64_t{blockIdx.x} * net.features * net.groups;
  const Tile tile{net, rows, shared, global(packed), mine, rows.first + int64_t{blockIdx.x} * 4 * net.groups};
  const int last = net.count - 1;
  tile.load(rows.x, net.inputs, 0, 0);
  __syncthreads();
  for (int l = 0; l < last; ++l) tile.forward(l);
  tile.load(rows.grad_y, net.layers[last].out, net.count, net.layers[last].grad);
  __syncthreads();
  const bool with_x = rows.grad_x != nullptr;
  for (int l = last; l > 0; --l) {
    if (with_x && net.layers[l].extra > 0) tile.back_to_x(l, net.layers[l].to_x, false);
    tile.back_to_hidden(l);
  }
  if (with_x) tile.back_to_x(0, net.layers[0].to_hidden, net.skip > 0);
}

// Gradients by weights ------------------------------------------------------------------------------------------------

// Block b sums over the tiles b / net.blocks, and every `sums`-th one after it, for the block b % net.blocks of weights, and for
// the biases beside its first column; adds to the sums of earlier launches unless this is the first.
__global__ void __launch_bounds__(kSideThreads* kSideThreads)
    perceptron_weights_kernel(Net net, const Four* kept, int64_t tiles, int sums, bool is_first, float* partials) {
  constexpr int kEach = kSide / kSideThreads, kStride = kPiece + 1;
  DYNGS_SHARED(Four, staged, 2 * kSide * kStride);
  const int thread = static_cast<int>(threadIdx.x), down = thread / kSideThreads, right = thread % kSideThreads;
  const int block = static_cast<int>(blockIdx.x) % net.blocks, part = static_cast<int>(blockIdx.x) / net.blocks;
  int l = 0;
  while (l + 1 < net.count && block >= net.layers[l + 1].block) ++l;
  const LayerPlace& p = net.layers[l];
  const int in = p.hidden + p.extra, across = (in + kSide - 1) / kSide;
  const int top = (block - p.block) / across * kSide, left = (block - p.block) % across * kSide;
  float sum[kEach][kEach] = {}, bias[kEach] = {};
  for (int64_t tile = part; tile < tiles; tile += sums) {
    const Fours from = global(kept) + tile * net.features * net.groups;
    for (int piece = 0; piece < net.groups; piece += kPiece) {
      for (int item = thread; item < 2 * kSide * kPiece; item += kSideThreads * kSideThreads) {
        const int f = item / kPiece, group = piece + item % kPiece, o = top + f, i = left + f - kSide;
        int feature = -1;
        if (f < kSide && o < p.out) feature = p.grad + o;
        if (f >= kSide && i < in) feature = i < p.hidden ? p.input + i : i - p.hidden;
        Four four{};
        if (feature >= 0 && group < net.groups) four = from[feature * net.groups + group];
        staged[f * kStride + item % kPiece] = four;
      }
      __syncthreads();
      DYNGS_UNROLL
      for (int q = 0; q < kPiece; ++q) {
        Four g[kEach], h[kEach];
        DYNGS_UNROLL
        for (int e = 0; e < kEach; ++e) {
          g[e] = staged[(down + kSideThreads * e) * kStride + q];
          h[e] = staged[(kSide + right + kSideThreads * e) * kStride + q];
        }
        DYNGS_UNROLL
        for (int at = 0; at < kEach * kEach * 4; ++at)
          sum[at / 16][at / 4 % 4] += g[at / 16].v[at % 4] * h[at / 4 % 4].v[at % 4];
        if (left == 0 && right == 0) {
          DYNGS_UNROLL
          for (int at = 0; at < kEach * 4; ++at) bias[at / 4] += g[at / 4].v[at % 4];
        }
      }
      __syncthreads();
    }
  }
  const Array<float> to = global(partials) + int64_t{part} * net.params + p.params;
  const auto add = [&](int at, float value) { to[at] = is_first ? value : to[at] + value; };
  DYNGS_UNROLL
  for (int e = 0; e < kEach; ++e) {
    const int o = top + down + kSideThreads * e;
    if (o >= p.out) continue;
    DYNGS_UNROLL
    for (int k = 0; k < kEach; ++k) {
      const int i = left + right + kSideThreads * k;
      if (i < in) add(o * in + i, sum[e][k]);
    }
    if (left == 0 && right == 0) add(p.out * in + o, bias[e]);
  }
}

// A warp's lanes for so many parameters, and slices of the sums, which are added in order.
__global__ void __launch_bounds__(kSlices* kWarpSize)
    perceptron_sum_kernel(const float* partials, int sums, int params, float* out) {
  DYNGS_SHARED(double, slices, kSlices* kWarpSize);
  const int thread = static_cast<int>(threadIdx.x), slice = thread / kWarpSize;
  const int at = static_cast<int>(blockIdx.x) * kWarpSize + thread % kWarpSize;
  double sum = 0;
  if (at < params)
    for (int s = slice; s < sums; s += kSlices)
      sum += static_cast<double>(float{global(partials)[int64_t{s} * params + at]});
  slices[thread] = sum;
  __syncthreads();
  if (slice > 0 || at >= params) return;
  for (int s = 1; s < kSlices; ++s) sum += static_cast<double>(slices[s * kWarpSize + thread]);
  global(out)[at] = static_cast<float>(sum);
}

// Plans ---------------------------------------------------------------------------------------------------------------

// The largest tiles whose activations fit.
void cut_rows(Net& net, const Perceptron<float>& from) {
  int sizes[2] = {};  // activations after an even and an odd number of layers
  for (int l = 0; l <= net.count; ++l)
    if (l > 0 || net.skip == 0) sizes[l % 2] = std::max(sizes[l % 2], padded(static_cast<int>(from.widths[l])));
  net.odd = sizes[0], net.x = net.skip == 0 ? 0 : sizes[0] + sizes[1];
  const int wide = sizes[0] + sizes[1] + (net.skip == 0 ? 0 : padded(net.inputs)), four = sizeof(Four);
  net.groups = kMostGroups;
  while (net.groups > kLeastGroups && wide * (net.groups + 1) * four > kShared) net.groups /= 2;
  net.shared_bytes = wide * (net.groups + 1) * four;
}

Net plan(const Perceptron<float>& from, bool backward) {
  if (!perceptron_fits(from)) throw std::length_error("a GPU's kernel takes up to 16 layers of up to 256 features");
  Net net{};
  net.count = static_cast<int>(from.layers()), net.skip = static_cast<int>(from.skip);
  net.inputs = static_cast<int>(from.widths[0]), net.features = padded(net.inputs);
  for (int l = 0; l < net.count; ++l) {
    LayerPlace& p = net.layers[l];
    p.hidden = static_cast<int>(from.hidden(l)), p.out = static_cast<int>(from.out(l));
    p.extra = static_cast<int>(from.in(l)) - p.hidden;
    const int in = p.hidden + p.extra;
    p.forward = net.packed, p.bias = p.forward + in * padded(p.out) / 4;
    p.to_hidden = p.to_x = net.packed = p.bias + padded(p.out) / 4;
    if (backward) {
      p.to_x = p.to_hidden + p.out * padded(p.hidden) / 4;
      net.packed = p.to_x + p.out * padded(p.extra) / 4;
    }
    if (l > 0) p.input = net.features, net.features += padded(p.hidden);
    p.grad = net.features, net.features += padded(p.out);
    p.params = net.params, net.params += p.out * (in + 1);
    p.block = net.blocks, net.blocks += ((in + kSide - 1) / kSide) * ((p.out + kSide - 1) / kSide);
  }
  cut_rows(net, from);
  return net;
}

struct Forward {
  Net net;
  Four* packed;
  Forward(const Perceptron<float>& from, Workspace& w) : net(plan(from, false)), packed(w.take<Four>(net.packed)) {}
};

struct Backward {
  Net net;
  int64_t tiles, at_once;  // of all rows, and of a launch
  int sums;
  Four *packed, *kept;
  float* partials;
  Backward(const Perceptron<float>& from, int64_t rows, int64_t bytes, Workspace& w) : net(plan(from, true)) {
    tiles = blocks_for(rows, 4 * net.groups);
    const int64_t tile_bytes = int64_t{net.features} * net.groups * int64_t{sizeof(Four)};
    at_once = std::min(tiles, std::max<int64_t>(1, bytes / tile_bytes));
    sums = static_cast<int>(std::min<int64_t>({at_once, kMostSums, blocks_for(kBlocks, net.blocks)}));
    packed = w.take<Four>(net.packed), kept = w.take<Four>(at_once * net.features * net.groups);
    partials = w.take<float>(int64_t{sums} * net.params);
  }
};

void pack(const Net& net, const float* params, Four* packed, Stream stream) {
  launch("pack_weights", {blocks_for(net.packed, kThreads), kThreads}, stream, pack_weights_kernel, net, params,
         packed);
}

}  // namespace

bool perceptron_fits(const Perceptron<float>& net) {
  return net.layers() <= kPerceptronLayers &&
         *std::max_element(net.widths.begin(), net.widths.end()) <= kPerceptronWidth;
}

int64_t perceptron_forward_workspace(const Perceptron<float>& net) {
  Workspace w(nullptr, 0);
  const Forward counted(net, w);
  return w.taken();
}

void perceptron_forward(const Perceptron<float>& from, int64_t rows, const float* x, float* y, const Lent& lent,
                        Stream stream) {
  Workspace workspace(lent.memory, lent.bytes);
  const auto [net, packed] = Forward(from, workspace);
  pack(net, from.params, packed, stream);
  launch("perceptron", {blocks_for(rows, 4 * net.groups), kThreads, net.shared_bytes}, stream, perceptron_kernel, net,
         Rows{x, nullptr, y, nullptr, 0, rows}, static_cast<const Four*>(packed));
}

int64_t perceptron_backward_workspace(const Perceptron<float>& net, int64_t rows, int64_t bytes) {
  Workspace w(nullptr, 0);
  const Backward counted(net, rows, bytes, w);
  return w.taken();
}

void perceptron_backward(const Perceptron<float>& from, int64_t rows, const float* x, const float* grad_y,
                         float* grad_x, float* grad_params, const Lent& lent, Stream stream, int64_t bytes) {
  Workspace workspace(lent.memory, lent.bytes);
  const Backward b(from, rows, bytes, workspace);
  const Four *packed = b.packed, *kept = b.kept;
  pack(b.net, from.params, b.packed, stream);
  for (int64_t begin = 0; begin < b.tiles; begin += b.at_once) {
    const int64_t count = std::min(b.at_once, b.tiles - begin);
    const Rows part{x, grad_y, nullptr, grad_x, begin * 4 * b.net.groups, rows};
    launch("perceptron_backward", {count, kThreads, b.net.shared_bytes}, stream, perceptron_backward_kernel, b.net,
           part, packed, b.kept);
    launch("perceptron_weights", {int64_t{b.sums} * b.net.blocks, kSideThreads * kSideThreads}, stream,
           perceptron_weights_kernel, b.net, kept, count, b.sums, begin == 0, b.partials);
  }
  launch("perceptron_sum", {blocks_for(b.net.params, kWarpSize), kSlices * kWarpSize}, stream, perceptron_sum_kernel,
         static_cast<const float*>(b.partials), b.sums, b.net.params, grad_params);
}

}  // namespace dyngs::cuda

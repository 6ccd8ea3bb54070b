// Linear blend skinning by control nodes (math/skinning.hpp). Forward, one thread per point and then one per blended number; what
// a node does is computed once and read from a table of 64 bytes per node. Backward, the pairs of points and nodes are sorted by
// node, stably, and a block adds up the pairs of one node: no atomics, the same bytes every time.
//
// Limits, H100 (3.35 TB/s, 67 TFLOP/s), B nodes per point, W blended numbers. Forward, per point: 12 + 8 B bytes read, 12 + 4 B + 4 W
// written, about 60 B + 2 B W operations; tables come from the cache. B = 4, W = 7: 100 bytes, 30 ps; 300 operations, 4 ps: bound by
// memory. Backward: two or three passes of the sort at 20 bytes per pair, then per pair 8 + 4 + 28 + 4 W bytes: 450 bytes per
// point, 0.13 ns. A node followed by most of many points is one block's work.
#include "cuda/api.hpp"
#include "cuda/reduce.hpp"
#include "cuda/rows.hpp"
#include "cuda/sort.hpp"
#include "math/skinning.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 128;
constexpr int kTurnSums = 12;  // by the columns of R - I and by the shift

// The values of a node that points read.
struct alignas(16) NodeRow {
  Vec3<float> place;
  float decay;
  Mat3<float> turn;  // R - I
  Vec3<float> shift;
};

__device__ Quat<float> load_rotation(const SkinNodes<float>& nodes, int64_t node) {
  const Array<const float> q = global(nodes.motion) + 7 * node + 3;
  return {q[0], q[1], q[2], q[3]};
}

__global__ void __launch_bounds__(kThreads) node_table_kernel(SkinNodes<float> nodes, NodeRow* table) {
  const int64_t s = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (s >= nodes.count) return;
  const Array<const float> p = global(nodes.positions) + 3 * s, d = global(nodes.motion) + 7 * s;
  NodeRow row;
  row.place = {p[0], p[1], p[2]}, row.shift = {d[0], d[1], d[2]};
  row.decay = weight_decay<float>(static_cast<float>(global(nodes.radii)[s]));
  row.turn = turn_of(load_rotation(nodes, s));
  global(table)[s] = row;
}

__device__ Vec3<float> column(const Mat3<float>& m, int j) { return {m.m[0][j], m.m[1][j], m.m[2][j]}; }

// Weights (the largest exponent is 0 before they are normalised) and the offset.
__global__ void __launch_bounds__(kThreads)
    offset_kernel(SkinPoints<float> points, const NodeRow* table, Skinned<float> out) {
  const int64_t m = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (m >= points.count) return;
  const Array<const int64_t> followed = global(points.followed) + m * points.nodes;
  const Array<float> weights = global(out.weights) + m * points.nodes;
  const Vec3<float> x = load3(points.coords, m);
  float top = -kLargest<float>;
  for (int64_t b = 0; b < points.nodes; ++b) {
    const NodeRow node = global(table)[followed[b]];
    const float exponent = weight_exponent(x - node.place, node.decay);
    weights[b] = exponent;
    top = top < exponent ? exponent : top;
  }
  float total = 0.f;
  for (int64_t b = 0; b < points.nodes; ++b) {
    const float weight = exp2(weights[b] - top);
    weights[b] = weight;
    total += weight;
  }
  const float inverse = 1.f / total;
  Vec3<float> offset{0.f, 0.f, 0.f};
  for (int64_t b = 0; b < points.nodes; ++b) {
    const NodeRow node = global(table)[followed[b]];
    const float weight = weights[b] * inverse;
    weights[b] = weight;
    const Vec3<float> columns[3] = {column(node.turn, 0), column(node.turn, 1), column(node.turn, 2)};
    offset = offset + moved_by(columns, node.shift, x - node.place) * weight;
  }
  store3(out.offset, m, offset);
}

__global__ void __launch_bounds__(kThreads)
    blended_kernel(SkinNodes<float> nodes, SkinPoints<float> points, Skinned<float> out) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= points.count * nodes.width) return;
  const int64_t m = i / nodes.width, k = i % nodes.width;
  float sum = 0.f;
  for (int64_t b = 0; b < points.nodes; ++b)
    sum += global(out.weights)[m * points.nodes + b] *
           global(nodes.values)[global(points.followed)[m * points.nodes + b] * nodes.width + k];
  global(out.blended)[i] = sum;
}

// The gradient by each point, through the rotations alone.
__global__ void __launch_bounds__(kThreads)
    by_point_kernel(SkinPoints<float> points, const NodeRow* table, Skinned<const float> g, float* by_points) {
  const int64_t m = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (m >= points.count) return;
  const Vec3<float> x = load3(points.coords, m), by_offset = load3(g.offset, m);
  Vec3<float> by_point{}, unused[3] = {}, unused_shift{};
  for (int64_t b = 0; b < points.nodes; ++b) {
    const NodeRow node = global(table)[global(points.followed)[m * points.nodes + b]];
    const Vec3<float> rows[3] = {load_vec3(node.turn.m[0]), load_vec3(node.turn.m[1]), load_vec3(node.turn.m[2])};
    moved_by_vjp(rows, x - node.place, by_offset * static_cast<float>(global(g.weights)[m * points.nodes + b]), unused,
                 unused_shift, by_point);
  }
  store3(by_points, m, by_point);
}

__global__ void __launch_bounds__(kThreads) node_keys_kernel(const int64_t* followed, int64_t count, Pairs out) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= count) return;
  global(out.keys)[i] = static_cast<uint32_t>(static_cast<int64_t>(global(followed)[i]));
  global(out.values)[i] = static_cast<int32_t>(i);
}

// One block per node: the sums over its pairs.
__global__ void __launch_bounds__(kThreads) by_node_kernel(SkinNodes<float> nodes, SkinPoints<float> points,
                                                           Pairs sorted, Skinned<const float> g, SkinGrads<float> out) {
  DYNGS_SHARED(double, warp_sums, kThreads / kWarpSize);
  const int64_t node = blockIdx.x, pairs = points.count * points.nodes;
  const int64_t begin = first_of(sorted.keys, pairs, node), end = first_of(sorted.keys, pairs, node + 1);
  const Vec3<float> place = load3(nodes.positions, node), zero_rows[3] = {};
  Vec3<float> by_columns[3] = {}, by_shift{}, unused{};
  for (int64_t i = begin + threadIdx.x; i < end; i += kThreads) {
    const int64_t pair = global(sorted.values)[i], m = pair / points.nodes;
    moved_by_vjp(zero_rows, load3(points.coords, m) - place,
                 load3(g.offset, m) * static_cast<float>(global(g.weights)[pair]), by_columns, by_shift, unused);
  }
  float sums[kTurnSums];
  for (int k = 0; k < kTurnSums; ++k)
    sums[k] = static_cast<float>(block_sum(double{k < 9 ? by_columns[k / 3][k % 3] : by_shift[k - 9]}, warp_sums));
  for (int64_t k = 0; k < nodes.width; ++k) {
    float mine = 0.f;
    for (int64_t i = begin + threadIdx.x; i < end; i += kThreads) {
      const int64_t pair = global(sorted.values)[i];
      mine += global(g.weights)[pair] * global(g.blended)[pair / points.nodes * nodes.width + k];
    }
    const double sum = block_sum(double{mine}, warp_sums);
    if (threadIdx.x == 0) global(out.values)[node * nodes.width + k] = static_cast<float>(sum);
  }
  if (threadIdx.x != 0) return;
  Mat3<float> by_turn;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) by_turn.m[i][j] = sums[3 * j + i];
  const Quat<float> by_quat = turn_vjp(load_rotation(nodes, node), by_turn);
  const Array<float> to = global(out.motion) + 7 * node;
  for (int k = 0; k < 3; ++k) to[k] = sums[9 + k];
  to[3] = by_quat.w, to[4] = by_quat.x, to[5] = by_quat.y, to[6] = by_quat.z;
}

NodeRow* node_table(const SkinNodes<float>& nodes, Workspace& workspace, Stream stream) {
  auto* table = workspace.take<NodeRow>(nodes.count);
  launch("node_table", {blocks_for(nodes.count, kThreads), kThreads}, stream, node_table_kernel, nodes, table);
  return table;
}

struct SortBuffers {
  Pairs pairs, other;
  SortScratch sort;
  SortBuffers(Workspace& w, int64_t count)
      : pairs{w.take<uint32_t>(count), w.take<int32_t>(count)},
        other{w.take<uint32_t>(count), w.take<int32_t>(count)},
        sort(w, count) {}
};

}  // namespace

int64_t skinning_forward_workspace(int64_t num_nodes) {
  Workspace w(nullptr, 0);
  w.take<NodeRow>(num_nodes);
  return w.taken();
}

void skinning_forward(const SkinNodes<float>& nodes, const SkinPoints<float>& points, const Skinned<float>& out,
                      const Lent& lent, Stream stream) {
  Workspace workspace(lent.memory, lent.bytes);
  const NodeRow* table = node_table(nodes, workspace, stream);
  launch("offset", {blocks_for(points.count, kThreads), kThreads}, stream, offset_kernel, points, table, out);
  launch("blended", {blocks_for(points.count * nodes.width, kThreads), kThreads}, stream, blended_kernel, nodes, points,
         out);
}

int64_t skinning_backward_workspace(int64_t num_nodes, int64_t num_points, int64_t nodes_per_point) {
  Workspace w(nullptr, 0);
  w.take<NodeRow>(num_nodes);
  const SortBuffers buffers(w, num_points * nodes_per_point);
  return w.taken();
}

void skinning_backward(const SkinNodes<float>& nodes, const SkinPoints<float>& points, const Skinned<const float>& g,
                       const SkinGrads<float>& grads, const Lent& lent, Stream stream) {
  Workspace workspace(lent.memory, lent.bytes);
  const NodeRow* table = node_table(nodes, workspace, stream);
  if (grads.points != nullptr)
    launch("by_point", {blocks_for(points.count, kThreads), kThreads}, stream, by_point_kernel, points, table, g,
           grads.points);
  const int64_t pairs = points.count * points.nodes;
  if (pairs > INT32_MAX)
    throw std::length_error(std::to_string(pairs) + " pairs of points and nodes are more than 2^31 - 1");
  const SortBuffers buffers(workspace, pairs);
  launch("node_keys", {blocks_for(pairs, kThreads), kThreads}, stream, node_keys_kernel, points.followed, pairs,
         buffers.pairs);
  const Pairs& sorted = stable_sort(buffers.pairs, buffers.other, pairs, bits_for(nodes.count), buffers.sort, stream);
  launch("by_node", {nodes.count, kThreads}, stream, by_node_kernel, nodes, points, sorted, g, grads);
}

}  // namespace dyngs::cuda

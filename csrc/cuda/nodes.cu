// Control nodes at a time, and the penalties of their motion with their gradients (math/nodes.hpp). A node is followed by many
// Gaussians, so that all of this is little work: one thread per node or number, and where several nodes have the same neighbour
// one thread per neighbour looks through all pairs, so that sums keep their order.
//
// Limits, H100: 512 nodes of 33 control points are 0.9 MB, and all kernels together bound by their launches, 3 us each.
#include "cuda/api.hpp"
#include "cuda/reduce.hpp"
#include "math/nodes.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 128;

__device__ Vec3<float> load3(const float* rows, int64_t at) {
  const Array<const float> from = global(rows) + at;
  return {from[0], from[1], from[2]};
}

__global__ void __launch_bounds__(kThreads)
    nodes_at_kernel(NodeSplines<float> splines, int64_t width, float* motion, float* values) {
  const int64_t s = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (s >= splines.count) return;
  const Array<float> row = global(motion) + 7 * s;
  for (int k = 3; k < 7; ++k) row[k] = k == 3 ? 1.f : 0.f;
  int64_t done = 0;
  for (int h = 0; h < kHeads; ++h) {
    if (splines.heads[h] == nullptr) continue;
    const int64_t size = head_size(h);
    const Array<const float> at = global(splines.heads[h]) + (s * splines.points + splines.first) * size;
    for (int64_t k = 0; k < size; ++k) {
      const float found = spline_value(at + k, size, splines.fractions);
      if (h == 0) row[k] = found;
      if (h == 1) row[3 + k] += found;
      if (h > 0) global(values)[width * s + done++] = found;
    }
  }
}

// Of one head, whose values begin at `offset`; one thread per number of the gradient.
__global__ void __launch_bounds__(kThreads)
    nodes_at_backward_kernel(NodeSplines<float> splines, int head, int64_t width, int64_t offset,
                             const float* by_motion, const float* by_values, float* grads) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x, size = head_size(head);
  if (i >= splines.count * splines.points * size) return;
  const int64_t s = i / (splines.points * size), point = i / size % splines.points - splines.first, k = i % size;
  float g = 0.f;
  if (point >= 0 && point < 4) {
    if (head < 2) g = global(by_motion)[7 * s + (head == 1 ? 3 : 0) + k];
    if (head > 0 && by_values != nullptr) g += static_cast<float>(global(by_values)[width * s + offset + k]);
    g *= splines.fractions[point];
  }
  global(grads)[i] = g;
}

// The second difference that begins at number i of a path of `size` numbers; 0 where there is none.
__device__ float bend_at(const Array<const float>& path, int64_t i, int64_t size) {
  if (i < 0 || i + 6 >= size) return 0.f;
  return static_cast<float>(path[i]) - 2.f * static_cast<float>(path[i + 3]) + static_cast<float>(path[i + 6]);
}

// The weight that turns a sum of squares into a mean in units of squared radii.
__device__ double weight_of(const NodeGraph<float>& graph, int64_t node, double count) {
  const double radius = static_cast<float>(global(graph.radii)[node]);
  return 1 / (radius * radius * count);
}

__global__ void __launch_bounds__(kThreads) bends_kernel(NodeGraph<float> graph, float* by_paths, double* partials) {
  DYNGS_SHARED(double, warp_sums, kThreads / kWarpSize);
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x, size = 3 * graph.points;
  double square = 0;
  if (i < graph.count * size) {
    const int64_t s = i / size, k = i % size;
    const Array<const float> path = global(graph.paths) + s * size;
    const double weight = weight_of(graph, s, double(graph.count) * double(size - 6));
    const float at = bend_at(path, k, size);
    global(by_paths)[i] =
        static_cast<float>(2 * weight) * (at - 2.f * bend_at(path, k - 3, size) + bend_at(path, k - 6, size));
    square = weight * at * at;
  }
  const double total = block_sum(square, warp_sums);
  if (threadIdx.x == 0) global(partials)[blockIdx.x] = total;
}

__global__ void __launch_bounds__(kThreads)
    strain_kernel(NodeGraph<float> graph, float* scaled, float* by_motion, double* partials) {
  DYNGS_SHARED(double, warp_sums, kThreads / kWarpSize);
  const int64_t s = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  double squares = 0;
  if (s < graph.count) {
    const double weight = weight_of(graph, s, double(graph.count) * double(graph.near));
    const Array<const float> q = global(graph.motion) + 7 * s + 3;
    const Quat<float> quat{q[0], q[1], q[2], q[3]};
    const Mat3<float> turn = turn_of(quat);
    const Vec3<float> place = load3(graph.positions, 3 * s), shift = load3(graph.motion, 7 * s);
    Mat3<float> by_turn{};
    Vec3<float> by_shift{0.f, 0.f, 0.f};
    for (int64_t b = s * graph.near; b < (s + 1) * graph.near; ++b) {
      const int64_t neighbour = global(graph.neighbours)[b];
      const Vec3<float> arm = load3(graph.positions, 3 * neighbour) - place;
      const Vec3<float> off = strain(turn, shift, arm, load3(graph.motion, 7 * neighbour));
      const Vec3<float> g = off * static_cast<float>(2 * weight);
      squares += weight * dot(off, off);
      strain_vjp(arm, g, by_turn);
      by_shift = by_shift - g;
      const Array<float> to = global(scaled) + 3 * b;
      to[0] = g.x, to[1] = g.y, to[2] = g.z;
    }
    const Quat<float> by_quat = turn_vjp(quat, by_turn);
    const Array<float> to = global(by_motion) + 7 * s;
    to[0] = by_shift.x, to[1] = by_shift.y, to[2] = by_shift.z;
    to[3] = by_quat.w, to[4] = by_quat.x, to[5] = by_quat.y, to[6] = by_quat.z;
  }
  const double total = block_sum(squares, warp_sums);
  if (threadIdx.x == 0) global(partials)[blockIdx.x] = total;
}

// Adds to each node what it has as a neighbour of others.
__global__ void __launch_bounds__(kThreads)
    neighbours_kernel(NodeGraph<float> graph, const float* scaled, float* by_motion) {
  const int64_t s = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (s >= graph.count) return;
  const Array<float> to = global(by_motion) + 7 * s;
  for (int64_t b = 0; b < graph.count * graph.near; ++b)
    if (static_cast<int64_t>(global(graph.neighbours)[b]) == s)
      for (int k = 0; k < 3; ++k) to[k] += static_cast<float>(global(scaled)[3 * b + k]);
}

// One block.
__global__ void __launch_bounds__(kThreads) sum_kernel(const double* partials, int64_t count, double* to) {
  DYNGS_SHARED(double, warp_sums, kThreads / kWarpSize);
  double mine = 0;
  for (int64_t k = threadIdx.x; k < count; k += kThreads) mine += global(partials)[k];
  const double sum = block_sum(mine, warp_sums);
  if (threadIdx.x == 0) global(to)[0] = sum;
}

int64_t width_of(const NodeSplines<float>& splines) {
  int64_t width = 0;
  for (int h = 1; h < kHeads; ++h) width += splines.heads[h] != nullptr ? head_size(h) : 0;
  return width;
}

struct PenaltyMemory {
  int64_t bend_blocks, strain_blocks;
  double *bends, *strains;
  float* scaled;

  PenaltyMemory(Workspace workspace, const NodeGraph<float>& graph, int64_t& bytes)
      : bend_blocks(blocks_for(graph.count * 3 * graph.points, kThreads)),
        strain_blocks(blocks_for(graph.count, kThreads)),
        bends(workspace.take<double>(bend_blocks)),
        strains(workspace.take<double>(strain_blocks)),
        scaled(workspace.take<float>(3 * graph.count * graph.near)) {
    bytes = workspace.taken();
  }
};

}  // namespace

void nodes_at(const NodeSplines<float>& splines, float* motion, float* values, Stream stream) {
  launch("nodes_at", {blocks_for(splines.count, kThreads), kThreads}, stream, nodes_at_kernel, splines,
         width_of(splines), motion, values);
}

void nodes_at_backward(const NodeSplines<float>& splines, const float* by_motion, const float* by_values,
                       const SplineGrads<float>& grads, Stream stream) {
  int64_t offset = 0;
  for (int h = 0; h < kHeads; ++h) {
    if (splines.heads[h] == nullptr) continue;
    launch("nodes_at_backward", {blocks_for(splines.count * splines.points * head_size(h), kThreads), kThreads}, stream,
           nodes_at_backward_kernel, splines, h, width_of(splines), offset, by_motion, by_values, grads.heads[h]);
    if (h > 0) offset += head_size(h);
  }
}

int64_t node_penalties_workspace(const NodeGraph<float>& graph) {
  int64_t bytes = 0;
  PenaltyMemory(Workspace(nullptr, 0), graph, bytes);
  return bytes;
}

void node_penalties(const NodeGraph<float>& graph, double* penalties, float* by_paths, float* by_motion,
                    const Lent& workspace, Stream stream) {
  int64_t bytes = 0;
  const PenaltyMemory memory(Workspace(workspace.memory, workspace.bytes), graph, bytes);
  launch("bends", {memory.bend_blocks, kThreads}, stream, bends_kernel, graph, by_paths, memory.bends);
  launch("strain", {memory.strain_blocks, kThreads}, stream, strain_kernel, graph, memory.scaled, by_motion,
         memory.strains);
  launch("neighbours", {memory.strain_blocks, kThreads}, stream, neighbours_kernel, graph,
         static_cast<const float*>(memory.scaled), by_motion);
  launch("sum", {1, kThreads}, stream, sum_kernel, static_cast<const double*>(memory.bends), memory.bend_blocks,
         penalties);
  launch("sum", {1, kThreads}, stream, sum_kernel, static_cast<const double*>(memory.strains), memory.strain_blocks,
         penalties + 1);
}

}  // namespace dyngs::cuda

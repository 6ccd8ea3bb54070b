// Smoothness and sparseness penalties of the planes with their gradient (math/planes.hpp), one thread per number of a plane, which
// reads its neighbours up to two rows and two columns away and needs nothing from other threads.
//
// Limits, H100 (3.35 TB/s, 67 TFLOP/s), per number: 4 bytes read, its eight neighbours mostly from the cache, 4 written, about 40
// operations: bound by memory, 2.4 ps.
#include "cuda/api.hpp"
#include "cuda/reduce.hpp"
#include "math/planes.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kAxes = 3;

// One plane (rows, columns, channels).
struct Plane {
  const float* values;
  float* grad;  // or null
  int64_t rows, columns, channels;
  PenaltyFactors factors;
  int64_t size() const { return rows * columns * channels; }
};

// The second difference at `i` of a line of `count` numbers, `stride` apart in memory; 0 at and beyond its ends.
__device__ float difference_at(const Array<const float>& line, int64_t i, int64_t count, int64_t stride) {
  if (i < 1 || i > count - 2) return 0.f;
  return second_difference(static_cast<float>(line[(i - 1) * stride]), static_cast<float>(line[i * stride]),
                           static_cast<float>(line[(i + 1) * stride]));
}

// Adds the gradient of factor times the sum of squares along a line by its number i to `grad`; returns the square at i.
__device__ float smoothness(const Array<const float>& line, int64_t i, int64_t count, int64_t stride, double factor,
                            float& grad) {
  const float at = difference_at(line, i, count, stride);
  grad += second_difference_vjp(difference_at(line, i - 1, count, stride), at,
                                difference_at(line, i + 1, count, stride), static_cast<float>(2 * factor));
  return at * at;
}

__global__ void __launch_bounds__(kThreads) penalty_kernel(Plane plane, double* partials) {
  DYNGS_SHARED(double, warp_sums, kThreads / kWarpSize);
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x, row_size = plane.columns * plane.channels;
  double sum = 0;
  if (i < plane.rows * row_size) {
    const int64_t row = i / row_size, column = i % row_size / plane.channels, channel = i % plane.channels;
    const Array<const float> values = global(plane.values);
    const PenaltyFactors& f = plane.factors;
    float grad = 0.f;
    sum = f.by_rows * smoothness(values + i % row_size, row, plane.rows, row_size, f.by_rows, grad);
    if (f.by_columns != 0)
      sum += f.by_columns *
             smoothness(values + (row * row_size + channel), column, plane.columns, plane.channels, f.by_columns, grad);
    const float distance = values[i] - 1.f;
    grad += distance_vjp(distance, static_cast<float>(f.one));
    sum += f.one * abs(distance);
    if (plane.grad != nullptr) global(plane.grad)[i] = grad;
  }
  const double total = block_sum(sum, warp_sums);
  if (threadIdx.x == 0) global(partials)[blockIdx.x] = total;
}

// One block.
__global__ void __launch_bounds__(kThreads)
    sum_penalties_kernel(const double* partials, int64_t count, double* penalty) {
  DYNGS_SHARED(double, warp_sums, kThreads / kWarpSize);
  double mine = 0;
  for (int64_t k = threadIdx.x; k < count; k += kThreads) mine += global(partials)[k];
  const double sum = block_sum(mine, warp_sums);
  if (threadIdx.x == 0) global(penalty)[0] = sum;
}

int64_t count_blocks(const HexPlane<float>& planes) {
  int64_t blocks = 0;
  for (const auto& level : planes.levels)
    blocks += kAxes * (blocks_for(level.size * level.size * planes.channels, kThreads) +
                       blocks_for(level.times * level.size * planes.channels, kThreads));
  return blocks;
}

}  // namespace

int64_t plane_penalty_workspace(const HexPlane<float>& planes) {
  return count_blocks(planes) * int64_t{sizeof(double)};
}

void plane_penalty(const HexPlane<float>& planes, const PenaltyWeights& weights,
                   std::span<const PlaneGrads<float>> grads, double* penalty, const Lent& workspace, Stream stream) {
  auto* partials = Workspace(workspace.memory, workspace.bytes).take<double>(count_blocks(planes));
  const int64_t channels = planes.channels;
  int64_t done = 0;
  const auto add = [&](const Plane& plane) {
    const int64_t blocks = blocks_for(plane.size(), kThreads);
    launch("penalty", {blocks, kThreads}, stream, penalty_kernel, plane, partials + done);
    done += blocks;
  };
  for (size_t l = 0; l < planes.levels.size(); ++l) {
    const PlaneLevel<float>& level = planes.levels[l];
    const int64_t space_size = level.size * level.size * channels, time_size = level.times * level.size * channels;
    const PenaltyFactors of_space = space_factors(weights.space, level.size, channels);
    const PenaltyFactors of_time = time_factors(weights.time, weights.one, level.times, level.size, channels);
    for (int p = 0; p < kAxes; ++p) {
      add({level.space + p * space_size, grads.empty() ? nullptr : grads[l].space + p * space_size, level.size,
           level.size, channels, of_space});
      add({level.time + p * time_size, grads.empty() ? nullptr : grads[l].time + p * time_size, level.times, level.size,
           channels, of_time});
    }
  }
  launch("sum_penalties", {1, kThreads}, stream, sum_penalties_kernel, static_cast<const double*>(partials), done,
         penalty);
}

}  // namespace dyngs::cuda

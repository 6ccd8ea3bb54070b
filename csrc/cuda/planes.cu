// Look-up in factored space-time grids (math/planes.hpp), level by level, one thread per point and channel. Backward, each thread
// first writes the gradients of its six samples' values; then, plane by plane, the points are sorted by the cell that they lie in,
// stably, and a block adds up what the cells around one sample hold: no atomics, the same bytes every time.
//
// Limits, H100 (3.35 TB/s, 67 TFLOP/s), C channels, one level. Forward, per point: 12 + 4 C bytes of its own and 18 samples of 4 C
// bytes, mostly from the cache; about 45 C operations. C = 32: 140 bytes, 42 ps, as long as planes fit the second-level cache.
// Backward: 4 C read, 36 C written and 40 C read again (four cells per sample of a plane, two of a line), six sorts of 2 or 3
// passes at 20 bytes: 3 KB, 0.9 ns. A cell with most of many points is one block's work.
#include "cuda/api.hpp"
#include "cuda/reduce.hpp"
#include "cuda/sort.hpp"
#include "math/planes.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 256, kParts = kThreads / kWarpSize;
constexpr int kAxes = 3;
DYNGS_HD constexpr int fast_axis(int plane) { return plane < 2 ? 0 : 1; }  // of the planes xy, xz, yz
DYNGS_HD constexpr int slow_axis(int plane) { return plane < 1 ? 1 : 2; }

// One level. A size of 1 has no second sample: steps are 0 there.
struct Level {
  const float *space, *lines;  // (3, size, size, C), (3, size, C)
  int64_t size, channels;
  DYNGS_HD int64_t step() const { return size > 1 ? 1 : 0; }
};

// The time planes, interpolated at the time of the call.
__global__ void __launch_bounds__(kThreads)
    lines_kernel(const float* time, TimeRows rows, int64_t times, int64_t row_size, float* lines) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= kAxes * row_size) return;
  const Array<const float> plane = global(time) + i / row_size * times * row_size;
  const int64_t k = i % row_size;
  const float one = plane[rows.first * row_size + k], two = plane[rows.second * row_size + k];
  global(lines)[i] = lerp(one, two, static_cast<float>(rows.weight));
}

struct Located {
  int64_t index[kAxes];
  float frac[kAxes];
};
__device__ Cell<float> locate_axis(const PlanePoints<float>& points, int64_t m, int axis, int64_t size) {
  return locate(static_cast<float>(global(points.coords)[kAxes * m + axis]), size);
}
__device__ Located locate_point(const PlanePoints<float>& points, int64_t m, int64_t size) {
  Located at;
  for (int a = 0; a < kAxes; ++a) {
    const Cell<float> cell = locate_axis(points, m, a, size);
    at.index[a] = static_cast<int64_t>(cell.index), at.frac[a] = cell.frac;
  }
  return at;
}

// The four samples of a plane, or the two of a line, around a point: one channel of each.
struct Samples {
  float a, b, c, d;
};
__device__ Samples plane_samples(const Level& level, int p, const Located& at, int64_t channel) {
  const Array<const float> from = global(level.space);
  const int64_t row = level.size * level.channels;
  const int64_t i = (p * level.size + at.index[slow_axis(p)]) * row + at.index[fast_axis(p)] * level.channels + channel;
  const int64_t right = level.step() * level.channels, below = level.step() * row;
  return {from[i], from[i + right], from[i + below], from[i + below + right]};
}
__device__ Samples line_samples(const Level& level, int a, const Located& at, int64_t channel) {
  const int64_t i = (a * level.size + at.index[a]) * level.channels + channel;
  return {global(level.lines)[i], global(level.lines)[i + level.step() * level.channels], 0.f, 0.f};
}

// `features`: from the level's first channel on, rows of `row_size`.
__global__ void __launch_bounds__(kThreads)
    features_kernel(Level level, PlanePoints<float> points, float* features, int64_t row_size) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= points.count * level.channels) return;
  const int64_t m = i / level.channels, channel = i % level.channels;
  const Located at = locate_point(points, m, level.size);
  float value[kAxes], line[kAxes];
  for (int p = 0; p < kAxes; ++p) {
    const Samples s = plane_samples(level, p, at, channel), along = line_samples(level, p, at, channel);
    value[p] = bilinear(s.a, s.b, s.c, s.d, at.frac[fast_axis(p)], at.frac[slow_axis(p)]);
    line[p] = lerp(along.a, along.b, at.frac[p]);
  }
  global(features)[m * row_size + channel] = plane_product(value, line);
}

// Gradients per point and channel.
struct PointGrads {
  float* planes;  // (3, M, C) by the interpolated values of the planes
  float* lines;   // (3, M, C)
  float* coords;  // (3, M, C) by index + fraction, or null
};

__global__ void __launch_bounds__(kThreads)
    point_grads_kernel(Level level, PlanePoints<float> points, const float* g_features, int64_t row_size,
                       PointGrads out) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x, size = points.count * level.channels;
  if (i >= size) return;
  const int64_t m = i / level.channels, channel = i % level.channels;
  const Located at = locate_point(points, m, level.size);
  PlaneValue<float> plane[kAxes];
  float line[kAxes], by_line[kAxes], g_plane[kAxes], g_line[kAxes], g[kAxes];
  for (int p = 0; p < kAxes; ++p) {
    const Samples s = plane_samples(level, p, at, channel), along = line_samples(level, p, at, channel);
    plane[p] = bilinear_slopes(s.a, s.b, s.c, s.d, at.frac[fast_axis(p)], at.frac[slow_axis(p)]);
    line[p] = lerp(along.a, along.b, at.frac[p]), by_line[p] = along.b - along.a;
  }
  plane_product_vjp(plane, line, static_cast<float>(global(g_features)[m * row_size + channel]), g_plane, g_line);
  coordinate_vjp(plane, by_line, g_plane, g_line, g);
  for (int p = 0; p < kAxes; ++p) {
    global(out.planes)[p * size + i] = g_plane[p];
    global(out.lines)[p * size + i] = g_line[p];
    if (out.coords != nullptr) global(out.coords)[p * size + i] = g[p];
  }
}

// Adds up the channels; the first level writes, others add.
__global__ void __launch_bounds__(kThreads) coords_kernel(PlanePoints<float> points, int64_t size, int64_t channels,
                                                          const float* parts, bool first, float* g_coords) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= kAxes * points.count) return;
  const int64_t m = i / kAxes, a = i % kAxes;
  float sum = 0.f;
  for (int64_t c = 0; c < channels; ++c) sum += global(parts)[(a * points.count + m) * channels + c];
  const float g = locate_vjp(static_cast<float>(global(points.coords)[i]), size, sum);
  global(g_coords)[i] = first ? g : static_cast<float>(global(g_coords)[i]) + g;
}

// A plane or a line whose samples gather gradients: `slow` is -1 for a line.
struct Target {
  int fast, slow;
  int64_t size;
  DYNGS_HD int64_t samples() const { return slow < 0 ? size : size * size; }
};

__global__ void __launch_bounds__(kThreads) cell_keys_kernel(Target target, PlanePoints<float> points, Pairs out) {
  const int64_t m = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (m >= points.count) return;
  const auto x = static_cast<int64_t>(locate_axis(points, m, target.fast, target.size).index);
  const int64_t y = target.slow < 0 ? 0 : static_cast<int64_t>(locate_axis(points, m, target.slow, target.size).index);
  const int64_t cell = y * target.size + x;
  global(out.keys)[m] = static_cast<uint32_t>(cell);
  global(out.values)[m] = static_cast<int32_t>(m);
}

// Points by cell, and the place of each cell's first one.
struct Sorted {
  const int32_t *points, *offsets;
};

// How much of a point's gradient falls to the corner (right, below) of its cell.
__device__ float corner_weight(const Target& target, const PlanePoints<float>& points, int64_t m, int right,
                               int below) {
  const float x = locate_axis(points, m, target.fast, target.size).frac;
  const float y = target.slow < 0 ? 0.f : locate_axis(points, m, target.slow, target.size).frac;
  float weight[4];  // of a line: the first two
  bilinear_weights(x, y, weight);
  return below == 0 ? (right == 0 ? weight[0] : weight[1]) : (right == 0 ? weight[2] : weight[3]);
}

// One block per sample (a single one has a cell of its own, all of it at the first corner): its warps share the points of the cells around it, lanes are channels; the warps' sums are added in
// their order. `from` (M, C), `to` (samples, C).
__global__ void __launch_bounds__(kThreads) gather_kernel(Target target, PlanePoints<float> points, Sorted sorted,
                                                          const float* from, int64_t channels, float* to) {
  DYNGS_SHARED(float, sums, kThreads);
  const int64_t sample = blockIdx.x, x = sample % target.size, y = sample / target.size;
  const int lane = static_cast<int>(threadIdx.x) % kWarpSize, part = static_cast<int>(threadIdx.x) / kWarpSize;
  for (int64_t first = 0; first < channels; first += kWarpSize) {
    const int64_t channel = first + lane;
    float sum = 0.f;
    for (int corner = 0; corner < (target.slow < 0 ? 2 : 4); ++corner) {
      const int right = corner % 2, below = corner / 2;
      const int64_t cell_x = x - right, cell_y = y - below;
      if (cell_x < 0 || cell_y < 0) continue;
      const int64_t cell = cell_y * target.size + cell_x, end = global(sorted.offsets)[cell + 1];
      for (int64_t k = global(sorted.offsets)[cell] + part; k < end; k += kParts) {
        const int64_t m = global(sorted.points)[k];
        const float weight = corner_weight(target, points, m, right, below);
        if (channel < channels) sum += weight * global(from)[m * channels + channel];
      }
    }
    sums[part * kWarpSize + lane] = sum;
    __syncthreads();
    if (part == 0 && channel < channels) {
      float total = 0.f;
      for (int k = 0; k < kParts; ++k) total += sums[k * kWarpSize + lane];
      global(to)[sample * channels + channel] = total;
    }
    __syncthreads();
  }
}

// Gradients by the time planes from those by the lines; zeros in all rows but two.
__global__ void __launch_bounds__(kThreads)
    time_grads_kernel(const float* g_lines, TimeRows rows, int64_t times, int64_t row_size, float* g_time) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= kAxes * times * row_size) return;
  const int64_t k = i % row_size, t = i / row_size % times, a = i / row_size / times;
  const float g = global(g_lines)[a * row_size + k], weight = static_cast<float>(rows.weight);
  global(g_time)[i] = (t == rows.first ? (1.f - weight) * g : 0.f) + (t == rows.second ? weight * g : 0.f);
}

int64_t largest_row(const HexPlane<float>& planes) {
  int64_t most = 0;
  for (const auto& level : planes.levels) most = max(most, level.size * planes.channels);
  return most;
}

Level make_level(const HexPlane<float>& planes, size_t l, float* lines, Stream stream) {
  const PlaneLevel<float>& level = planes.levels[l];
  const int64_t row_size = level.size * planes.channels;
  launch("lines", {blocks_for(kAxes * row_size, kThreads), kThreads}, stream, lines_kernel, level.time,
         time_rows(planes.time, level.times), level.times, row_size, lines);
  return {level.space, lines, level.size, planes.channels};
}

struct BackwardBuffers {
  float *lines, *g_lines;
  PointGrads points;
  Pairs pairs, other;
  int32_t* offsets;
  SortScratch sort;
  BackwardBuffers(Workspace& w, const HexPlane<float>& planes, int64_t count)
      : lines(w.take<float>(kAxes * largest_row(planes))),
        g_lines(w.take<float>(kAxes * largest_row(planes))),
        points{w.take<float>(kAxes * count * planes.channels), w.take<float>(kAxes * count * planes.channels),
               w.take<float>(kAxes * count * planes.channels)},
        pairs{w.take<uint32_t>(count), w.take<int32_t>(count)},
        other{w.take<uint32_t>(count), w.take<int32_t>(count)},
        offsets(w.take<int32_t>(most_samples(planes) + 1)),
        sort(w, count) {}

  static int64_t most_samples(const HexPlane<float>& planes) {
    int64_t most = 0;
    for (const auto& level : planes.levels) most = max(most, level.size * level.size);
    return most;
  }
};

// Gradients by the samples of one plane or line.
void gather(const Target& target, const PlanePoints<float>& points, const float* from, int64_t channels, float* to,
            const BackwardBuffers& b, Stream stream) {
  const int64_t cells = target.samples(), blocks = blocks_for(points.count, kThreads);
  launch("cell_keys", {blocks, kThreads}, stream, cell_keys_kernel, target, points, b.pairs);
  const Pairs& sorted = stable_sort(b.pairs, b.other, points.count, bits_for(cells), b.sort, stream);
  find_offsets(sorted.keys, points.count, cells, b.offsets, stream);
  launch("gather", {cells, kThreads}, stream, gather_kernel, target, points, Sorted{sorted.values, b.offsets}, from,
         channels, to);
}

}  // namespace

int64_t hexplane_forward_workspace(const HexPlane<float>& planes) {
  return kAxes * largest_row(planes) * int64_t{sizeof(float)};
}

void hexplane_forward(const HexPlane<float>& planes, const PlanePoints<float>& points, float* features,
                      const Lent& workspace, Stream stream) {
  auto* lines = Workspace(workspace.memory, workspace.bytes).take<float>(kAxes * largest_row(planes));
  const int64_t channels = planes.channels, row_size = channels * static_cast<int64_t>(planes.levels.size());
  for (size_t l = 0; l < planes.levels.size(); ++l)
    launch("features", {blocks_for(points.count * channels, kThreads), kThreads}, stream, features_kernel,
           make_level(planes, l, lines, stream), points, features + static_cast<int64_t>(l) * channels, row_size);
}

int64_t hexplane_backward_workspace(const HexPlane<float>& planes, int64_t num_points) {
  Workspace w(nullptr, 0);
  const BackwardBuffers buffers(w, planes, num_points);
  return w.taken();
}

void hexplane_backward(const HexPlane<float>& planes, const PlanePoints<float>& points, const float* g_features,
                       std::span<const PlaneGrads<float>> grads, float* g_coords, const Lent& lent, Stream stream) {
  Workspace workspace(lent.memory, lent.bytes);
  const BackwardBuffers b(workspace, planes, points.count);
  const int64_t channels = planes.channels, row_size = channels * static_cast<int64_t>(planes.levels.size());
  const int64_t size = points.count * channels;
  for (size_t l = 0; l < planes.levels.size(); ++l) {
    const Level level = make_level(planes, l, b.lines, stream);
    const PointGrads point_grads{b.points.planes, b.points.lines, g_coords == nullptr ? nullptr : b.points.coords};
    launch("point_grads", {blocks_for(size, kThreads), kThreads}, stream, point_grads_kernel, level, points,
           g_features + static_cast<int64_t>(l) * channels, row_size, point_grads);
    if (g_coords != nullptr)
      launch("coords", {blocks_for(kAxes * points.count, kThreads), kThreads}, stream, coords_kernel, points,
             level.size, channels, static_cast<const float*>(b.points.coords), l == 0, g_coords);
    for (int p = 0; p < kAxes; ++p) {
      gather({fast_axis(p), slow_axis(p), level.size}, points, b.points.planes + p * size, channels,
             grads[l].space + p * level.size * level.size * channels, b, stream);
      gather({p, -1, level.size}, points, b.points.lines + p * size, channels, b.g_lines + p * level.size * channels, b,
             stream);
    }
    const int64_t times = planes.levels[l].times, row = level.size * channels;
    launch("time_grads", {blocks_for(kAxes * times * row, kThreads), kThreads}, stream, time_grads_kernel,
           static_cast<const float*>(b.g_lines), time_rows(planes.time, times), times, row, grads[l].time);
  }
}

}  // namespace dyngs::cuda

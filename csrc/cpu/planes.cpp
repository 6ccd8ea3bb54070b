// Planes larger than the cache are read and written at random places if points come in random order, so points are
// visited cell by cell of a coarse grid. The backward pass gives each task the gradients of one level and one packet of
// channels, which it alone writes, point by point in that order: no atomics, the same sums on any number of threads.
#include "core/api.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "cpu/parallel.hpp"
#include "cpu/simd.hpp"
#include "math/planes.hpp"

namespace dyngs {
namespace {

constexpr int64_t kGrain = 32 * kLanes;  // points
constexpr int kAxes = 3;
constexpr int kFast[kAxes] = {0, 0, 1};  // axes of the planes xy, xz, yz
constexpr int kSlow[kAxes] = {1, 2, 2};
constexpr int64_t kCells = 16;  // of the coarse grid, along each axis

// NaN counts as cell 0.
template <class S>
int64_t coarse_cell(S u) {
  const S x = (u + S(1)) * S(kCells / 2);
  return x >= S(1) ? static_cast<int64_t>(std::min(x, S(kCells - 1))) : 0;
}

// A stable counting sort by coarse cell.
template <class S>
void sort_points(const PlanePoints<S>& points, int32_t* order) {
  std::vector<int32_t> keys(points.count), next(kCells * kCells * kCells + 1, 0);
  for (int64_t i = 0; i < points.count; ++i) {
    const S* u = points.coords + kAxes * i;
    keys[i] = static_cast<int32_t>((coarse_cell(u[2]) * kCells + coarse_cell(u[1])) * kCells + coarse_cell(u[0]));
    ++next[keys[i] + 1];
  }
  for (size_t k = 1; k < next.size(); ++k) next[k] += next[k - 1];
  for (int64_t i = 0; i < points.count; ++i) order[next[keys[i]]++] = static_cast<int32_t>(i);
}

// The coordinates of up to 16 points, axis by axis; 0 where there are fewer.
template <class S>
struct Chunk {
  S coords[kAxes][kLanes];
  int32_t index[kLanes];
  int count;
};

template <class S>
Chunk<S> load_chunk(const PlanePoints<S>& points, const int32_t* order, int64_t begin) {
  Chunk<S> chunk{};
  chunk.count = static_cast<int>(std::min<int64_t>(kLanes, points.count - begin));
  for (int i = 0; i < chunk.count; ++i) {
    chunk.index[i] = order[begin + i];
    for (int a = 0; a < kAxes; ++a) chunk.coords[a][i] = points.coords[kAxes * int64_t{chunk.index[i]} + a];
  }
  return chunk;
}

template <class S>
std::vector<Chunk<S>> load_chunks(const PlanePoints<S>& points, const int32_t* order, int threads) {
  std::vector<Chunk<S>> chunks((points.count + kLanes - 1) / kLanes);
  parallel_for(points.count, kGrain, threads, [&](int64_t first, int64_t end) {
    for (int64_t begin = first; begin < end; begin += kLanes) chunks[begin / kLanes] = load_chunk(points, order, begin);
  });
  return chunks;
}

// Positions of a chunk's points between the samples of one level: index + frac, along each axis.
template <class S>
struct Cells {
  int32_t index[kAxes][kLanes];
  Packet<S> frac[kAxes];
};

template <class S>
Cells<S> locate_chunk(const Chunk<S>& chunk, int64_t size) {
  Cells<S> cells;
  for (int a = 0; a < kAxes; ++a) {
    const Cell<Packet<S>> cell = locate(Packet<S>::load(chunk.coords[a]), size);
    for (int i = 0; i < kLanes; ++i) cells.index[a][i] = static_cast<int32_t>(cell.index[i]);
    cells.frac[a] = cell.frac;
  }
  return cells;
}

// The time planes of a level, interpolated at the one time of the call: (3, size, C).
template <class S>
std::vector<S> lines_at_time(const PlaneLevel<S>& level, int64_t channels, double time) {
  const TimeRows rows = time_rows(time, level.times);
  const int64_t row_size = level.size * channels;
  const S weight = static_cast<S>(rows.weight);
  std::vector<S> lines(kAxes * row_size);
  for (int a = 0; a < kAxes; ++a) {
    const S* plane = level.time + a * level.times * row_size;
    const S *one = plane + rows.first * row_size, *two = plane + rows.second * row_size;
    for (int64_t k = 0; k < row_size; ++k) lines[a * row_size + k] = lerp(one[k], two[k], weight);
  }
  return lines;
}

template <class S>
std::vector<std::vector<S>> all_lines(const HexPlane<S>& planes) {
  std::vector<std::vector<S>> lines;
  lines.reserve(planes.levels.size());
  for (const auto& level : planes.levels) lines.push_back(lines_at_time(level, planes.channels, planes.time));
  return lines;
}

// All channels of a register, or the first few and zeros.
template <bool full, class S>
inline Native<S> load(const S* from, int width) {
  if constexpr (full) return Native<S>::load(from);
  Native<S> r(S(0));
  for (int i = 0; i < width; ++i) r[i] = from[i];
  return r;
}
template <bool full, class S>
inline void store(S* to, Native<S> x, int width) {
  if constexpr (full) {
    x.store(to);
  } else {
    for (int i = 0; i < width; ++i) to[i] = x[i];
  }
}
template <bool full, class S>
inline void add(S* to, Native<S> x, S weight, int width) {
  store<full, S>(to, load<full, S>(to, width) + weight * x, width);
}

// One level as the inner loops see it. A size of 1 has no second sample, so steps are 0 there.
template <class S>
struct LevelView {
  const S* space;
  const S* lines;
  int64_t size, channels, step, row;  // the last two are strides in elements

  LevelView(const PlaneLevel<S>& level, const std::vector<S>& lines, int64_t channels)
      : space(level.space),
        lines(lines.data()),
        size(level.size),
        channels(channels),
        step(level.size > 1 ? channels : 0),
        row(level.size > 1 ? level.size * channels : 0) {}
};

// Offsets of the first samples that a chunk's points read in the six planes, and the weights of the samples next to them.
template <class S>
struct Places {
  int64_t corner[kAxes][kLanes];
  int64_t sample[kAxes][kLanes];
  Packet<S> frac[kAxes];

  Places(const LevelView<S>& level, const Cells<S>& cells) {
    const int64_t line = level.size * level.channels, plane = level.size * line;
    for (int k = 0; k < kAxes; ++k) {
      frac[k] = cells.frac[k];
      const auto *x = cells.index[kFast[k]], *y = cells.index[kSlow[k]], *along = cells.index[k];
      for (int i = 0; i < kLanes; ++i) {
        corner[k][i] = k * plane + y[i] * line + x[i] * level.channels;
        sample[k][i] = k * line + along[i] * level.channels;
      }
    }
  }
};

template <bool full, class S>
inline Native<S> feature(const LevelView<S>& level, const Places<S>& places, int i, int64_t channel, int width) {
  Native<S> value[kAxes], line[kAxes];
#pragma GCC unroll 3
  for (int p = 0; p < kAxes; ++p) {
    const S *at = level.space + places.corner[p][i] + channel, *below = at + level.row;
    const S x = places.frac[kFast[p]][i], y = places.frac[kSlow[p]][i];
    value[p] = bilinear(load<full>(at, width), load<full>(at + level.step, width), load<full>(below, width),
                        load<full>(below + level.step, width), x, y);
  }
#pragma GCC unroll 3
  for (int a = 0; a < kAxes; ++a) {
    const S* at = level.lines + places.sample[a][i] + channel;
    line[a] = lerp(load<full>(at, width), load<full>(at + level.step, width), places.frac[a][i]);
  }
  return plane_product(value, line);
}

template <class S>
void chunk_features(const LevelView<S>& level, const Chunk<S>& chunk, S* features, int64_t row_size) {
  constexpr int kWidth = Native<S>::kSize;
  const Places<S> places(level, locate_chunk(chunk, level.size));
  for (int i = 0; i < chunk.count; ++i) {
    S* to = features + chunk.index[i] * row_size;
    int64_t c = 0;
    for (; c + kWidth <= level.channels; c += kWidth)
      store<true, S>(to + c, feature<true>(level, places, i, c, kWidth), kWidth);
    const int rest = static_cast<int>(level.channels - c);
    if (rest > 0) store<false, S>(to + c, feature<false>(level, places, i, c, rest), rest);
  }
}

// The gradients that one task of the backward pass owns: of one level and up to 16 channels; of all planes, or where
// there are more threads than such tasks, of one plane over space and one over time (each then computes the rest again).
template <class S>
struct Task {
  LevelView<S> level;  // from the first channel of the task on
  const S* g_features;
  S* g_space;
  S* g_time;
  S* g_coords;  // (3, count) in visiting order, or nullptr
  int width;
  bool owns[kAxes];
  TimeRows rows;
  int64_t times;
};

// Offsets and weights with which a chunk's gradients are added to the four samples of each plane and the two of each line.
template <class S>
struct Scatter {
  int64_t line[kAxes][kLanes];
  Packet<S> corner_weight[kAxes][4];
  Packet<S> line_weight[kAxes][2];

  Scatter(const LevelView<S>& level, const Cells<S>& cells) {
    for (int k = 0; k < kAxes; ++k) {
      bilinear_weights(cells.frac[kFast[k]], cells.frac[kSlow[k]], corner_weight[k]);
      line_weight[k][0] = Packet<S>(S(1)) - cells.frac[k];
      line_weight[k][1] = cells.frac[k];
      for (int i = 0; i < kLanes; ++i) line[k][i] = (k * level.size + cells.index[k][i]) * kLanes;
    }
  }
};

// Gradients by the three coordinates, a register of channels for each.
template <class S>
struct CoordGrad {
  Native<S> axis[kAxes];
};

// Adds the gradients by the planes of point i of a chunk, a register of channels; returns those by its coordinates, if
// asked for.
template <bool full, bool with_coords, class S>
inline CoordGrad<S> point_gradients(const Task<S>& task, const Places<S>& places, const Scatter<S>& scatter, int i,
                                    Native<S> g, S* g_lines, int channel, int width) {
  using V = Native<S>;
  const int64_t step = task.level.step, row = task.level.row;
  PlaneValue<V> plane[kAxes];
  V line[kAxes], by_line[kAxes];
#pragma GCC unroll 3
  for (int p = 0; p < kAxes; ++p) {
    const S *at = task.level.space + places.corner[p][i] + channel, *below = at + row;
    const S x = places.frac[kFast[p]][i], y = places.frac[kSlow[p]][i];
    plane[p] = bilinear_slopes(load<full>(at, width), load<full>(at + step, width), load<full>(below, width),
                               load<full>(below + step, width), x, y);
  }
#pragma GCC unroll 3
  for (int a = 0; a < kAxes; ++a) {
    const S* at = task.level.lines + places.sample[a][i] + channel;
    const V one = load<full>(at, width), two = load<full>(at + step, width);
    by_line[a] = two - one;
    line[a] = lerp(one, two, places.frac[a][i]);
  }
  V g_value[kAxes], g_line[kAxes];
  plane_product_vjp(plane, line, g, g_value, g_line);
#pragma GCC unroll 3
  for (int p = 0; p < kAxes; ++p) {
    if (!task.owns[p]) continue;
    S *at = task.g_space + places.corner[p][i] + channel, *below = at + row;
    const auto& weight = scatter.corner_weight[p];
    add<full, S>(at, g_value[p], weight[0][i], width);
    add<full, S>(at + step, g_value[p], weight[1][i], width);
    add<full, S>(below, g_value[p], weight[2][i], width);
    add<full, S>(below + step, g_value[p], weight[3][i], width);
    S* of_line = g_lines + scatter.line[p][i] + channel;
    add<full, S>(of_line, g_line[p], scatter.line_weight[p][0][i], width);
    add<full, S>(of_line + (step ? kLanes : 0), g_line[p], scatter.line_weight[p][1][i], width);
  }
  CoordGrad<S> by_coords{};
  if constexpr (with_coords) coordinate_vjp(plane, by_line, g_value, g_line, by_coords.axis);
  return by_coords;
}

// Sums over channels, in a fixed order, times d index / d coordinate, which is 0 where the coordinate was clamped.
template <class S>
void store_coords(const Task<S>& task, const Chunk<S>& chunk, const CoordGrad<S>* grads, int64_t begin, int64_t count) {
  constexpr int kWidth = Native<S>::kSize, kFold = std::min(kWidth, 4);
  for (int i = 0; i < chunk.count; ++i)
    for (int a = 0; a < kAxes; ++a) {
      S lanes[kWidth], sum = 0;
      std::memcpy(lanes, &grads[i].axis[a], sizeof lanes);
      for (int c = kFold; c < kWidth; ++c) lanes[c % kFold] += lanes[c];
      for (int c = 0; c < kFold; ++c) sum += lanes[c];
      task.g_coords[a * count + begin + i] = locate_vjp(chunk.coords[a][i], task.level.size, sum);
    }
}

// Distributes the gradients by the lines (3, size, 16) to the two rows of the time planes.
template <class S>
void store_lines(const Task<S>& task, const S* g_lines) {
  const S weight = static_cast<S>(task.rows.weight);
  const int64_t row_size = task.level.size * task.level.channels;
  for (int a = 0; a < kAxes; ++a) {
    if (!task.owns[a]) continue;
    S* plane = task.g_time + a * task.times * row_size;
    for (int64_t k = 0; k < task.level.size; ++k) {
      const S* g = g_lines + (a * task.level.size + k) * kLanes;
      S* to = plane + k * task.level.channels;
      for (int c = 0; c < task.width; ++c) {
        to[task.rows.first * row_size + c] += (1 - weight) * g[c];
        to[task.rows.second * row_size + c] += weight * g[c];
      }
    }
  }
}

// `g_lines`: scratch memory for the gradients of the task's lines.
template <bool full, bool with_coords, class S>
void run_task(const Task<S>& given, const std::vector<Chunk<S>>& chunks, int64_t count, int64_t row_size, S* g_lines) {
  constexpr int kWidth = Native<S>::kSize;
  const Task<S> task = given;
  const int task_width = full ? kLanes : task.width;
  std::fill_n(g_lines, kAxes * task.level.size * kLanes, S(0));
  CoordGrad<S> g_coords[kLanes];
  for (size_t n = 0; n < chunks.size(); ++n) {
    const Chunk<S>& chunk = chunks[n];
    const Cells<S> cells = locate_chunk(chunk, task.level.size);
    const Places<S> places(task.level, cells);
    const Scatter<S> scatter(task.level, cells);
    if (n + 1 < chunks.size())
      for (const int32_t next : chunks[n + 1].index) __builtin_prefetch(task.g_features + next * row_size);
    for (int i = 0; i < chunk.count; ++i) {
      const S* from = task.g_features + chunk.index[i] * row_size;
      CoordGrad<S> sum{};
#pragma GCC unroll 4
      for (int c = 0; c < task_width; c += kWidth) {
        const int width = full ? kWidth : std::min(kWidth, task_width - c);
        const Native<S> g = load<full>(from + c, width);
        const auto part = point_gradients<full, with_coords>(task, places, scatter, i, g, g_lines, c, width);
        for (int a = 0; a < kAxes; ++a) sum.axis[a] += part.axis[a];
      }
      g_coords[i] = sum;
    }
    if constexpr (with_coords) store_coords(task, chunk, g_coords, n * kLanes, count);
  }
  store_lines(task, g_lines);
}

template <class S>
void clear(S* to, int64_t count, int threads) {
  parallel_for(count, 1 << 16, threads,
               [&](int64_t begin, int64_t end) { std::memset(to + begin, 0, (end - begin) * sizeof(S)); });
}

template <class S>
std::vector<LevelView<S>> level_views(const HexPlane<S>& planes, const std::vector<std::vector<S>>& lines) {
  std::vector<LevelView<S>> views;
  views.reserve(lines.size());
  for (size_t l = 0; l < lines.size(); ++l) views.emplace_back(planes.levels[l], lines[l], planes.channels);
  return views;
}

// Sums the tasks' parts (parts, 3, count) in order, and puts the sums into the order of the points.
template <class S>
void sum_coords(const std::vector<S>& parts, const int32_t* order, int64_t count, S* g_coords, int threads) {
  const int64_t num_parts = count ? static_cast<int64_t>(parts.size()) / (kAxes * count) : 0;
  parallel_for(count, kGrain, threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i)
      for (int a = 0; a < kAxes; ++a) {
        S sum = 0;
        for (int64_t p = 0; p < num_parts; ++p) sum += parts[(p * kAxes + a) * count + i];
        g_coords[kAxes * int64_t{order[i]} + a] = sum;
      }
  });
}

}  // namespace

template <class S>
void hexplane_forward(const HexPlane<S>& planes, const PlanePoints<S>& points, S* features, int32_t* order,
                      int threads) {
  sort_points(points, order);
  const auto lines = all_lines(planes);
  const auto views = level_views(planes, lines);
  const int64_t row_size = planes.channels * static_cast<int64_t>(views.size());
  parallel_for(points.count, kGrain, threads, [&](int64_t first, int64_t end) {
    for (int64_t begin = first; begin < end; begin += kLanes) {
      const Chunk<S> chunk = load_chunk(points, order, begin);
      for (size_t l = 0; l < views.size(); ++l)
        chunk_features(views[l], chunk, features + l * planes.channels, row_size);
    }
  });
}

template <class S>
void hexplane_backward(const HexPlane<S>& planes, const PlanePoints<S>& points, const int32_t* order,
                       const S* g_features, std::span<const PlaneGrads<S>> grads, S* g_coords, int threads) {
  const auto chunks = load_chunks(points, order, threads);
  const auto lines = all_lines(planes);
  const auto views = level_views(planes, lines);
  const int64_t channels = planes.channels, num_levels = views.size();
  const int64_t num_blocks = (channels + kLanes - 1) / kLanes, coords_size = kAxes * points.count;
  std::vector<S> parts(g_coords ? num_levels * num_blocks * coords_size : 0);
  std::vector<Task<S>> tasks;
  const bool split = threads > num_levels * num_blocks;
  for (int64_t l = 0; l < num_levels; ++l) {
    const PlaneLevel<S>& level = planes.levels[l];
    clear(grads[l].space, kAxes * level.size * level.size * channels, threads);
    clear(grads[l].time, kAxes * level.times * level.size * channels, threads);
    for (int64_t c = 0; c < channels; c += kLanes)
      for (int share = 0; share < (split ? kAxes : 1); ++share) {
        LevelView<S> view = views[l];
        view.space += c;
        view.lines += c;
        const bool has_coords = g_coords && share == 0;
        S* part = has_coords ? parts.data() + (l * num_blocks + c / kLanes) * coords_size : nullptr;
        tasks.push_back({view,
                         g_features + l * channels + c,
                         grads[l].space + c,
                         grads[l].time + c,
                         part,
                         static_cast<int>(std::min<int64_t>(kLanes, channels - c)),
                         {!split || share == 0, !split || share == 1, !split || share == 2},
                         time_rows(planes.time, level.times),
                         level.times});
      }
  }
  int64_t longest = 0;
  for (const auto& level : planes.levels) longest = std::max(longest, kAxes * level.size * kLanes);
  const auto g_lines = for_each_worker<std::vector<S>>(threads, longest);
  parallel_workers(static_cast<int64_t>(tasks.size()), 1, threads, [&](int worker, int64_t t, int64_t) {
    const Task<S>& task = tasks[t];
    const bool full = task.width == kLanes;
    const auto run = task.g_coords ? (full ? run_task<true, true, S> : run_task<false, true, S>)
                                   : (full ? run_task<true, false, S> : run_task<false, false, S>);
    run(task, chunks, points.count, channels * num_levels, g_lines[worker]->data());
  });
  if (g_coords) sum_coords(parts, order, points.count, g_coords, threads);
}

template void hexplane_forward<float>(const HexPlane<float>&, const PlanePoints<float>&, float*, int32_t*, int);
template void hexplane_forward<double>(const HexPlane<double>&, const PlanePoints<double>&, double*, int32_t*, int);
template void hexplane_backward<float>(const HexPlane<float>&, const PlanePoints<float>&, const int32_t*, const float*,
                                       std::span<const PlaneGrads<float>>, float*, int);
template void hexplane_backward<double>(const HexPlane<double>&, const PlanePoints<double>&, const int32_t*,
                                        const double*, std::span<const PlaneGrads<double>>, double*, int);

}  // namespace dyngs

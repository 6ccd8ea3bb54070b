// All data of a node lie in one row of a table, in vectors of four (x, y, z and a spare lane), so that a point and a node need
// a few short vector operations. The backward pass splits the points into contiguous parts, whose number depends on the
// sizes only; each part sums its own gradients by all nodes in order, and these are then summed in order.
#include "core/api.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <memory>
#include <vector>

#include "cpu/parallel.hpp"
#include "cpu/simd.hpp"
#include "math/skinning.hpp"

namespace dyngs {
namespace {

constexpr int64_t kGrain = 512;  // points
constexpr int64_t kNodeGrain = 64;
constexpr int64_t kMaxParts = 16;

template <class S>
using Four = Simd<S, 4>;

// Vectors of a table row: the position with the weight's decay in the spare lane; R - I, by column in the forward and by
// row in the backward pass; and in the forward pass the shift and the values.
constexpr int kPlace = 0, kTurn = 1, kShift = 4, kValues = 5;
// Vectors of a gradient row: by the columns of R, the shift and the values.
constexpr int kByTurn = 0, kByShift = 3, kByValues = 4;

template <class S>
inline Four<S> load_some(const S* from, int64_t count) {
  if (count >= 4) return Four<S>::load(from);
  Four<S> r(S(0));
  for (int i = 0; i < count; ++i) r[i] = from[i];
  return r;
}
template <class S>
inline Four<S> four(S x, S y, S z, S w) {
  const S numbers[] = {x, y, z, w};
  return Four<S>::load(numbers);
}
template <class S>
inline Four<S> load_three(const S* from) {
  return four(from[0], from[1], from[2], S(0));
}

template <class S>
inline void store_some(S* to, Four<S> x, int64_t count) {
  if (count >= 4) {
    x.store(to);
  } else {
    for (int i = 0; i < count; ++i) to[i] = x[i];
  }
}

inline int64_t fours(int64_t width) { return (width + 3) / 4; }

template <class S>
Quat<S> quaternion(const SkinNodes<S>& nodes, int64_t node) {
  return load_quat(nodes.motion + 7 * node + 3);
}

template <class S>
struct Table {
  int64_t stride;
  std::vector<Four<S>> rows;

  const Four<S>* operator[](int64_t node) const { return rows.data() + node * stride; }
};

template <class S>
Table<S> node_table(const SkinNodes<S>& nodes, bool forward) {
  const int64_t stride = forward ? kValues + fours(nodes.width) : kShift;
  Table<S> table{stride, std::vector<Four<S>>(nodes.count * stride)};
  for (int64_t s = 0; s < nodes.count; ++s) {
    Four<S>* row = table.rows.data() + s * stride;
    row[kPlace] = load_three(nodes.positions + 3 * s);
    row[kPlace][3] = weight_decay<S>(nodes.radii[s]);
    const Mat3<S> turn = turn_of(quaternion(nodes, s));
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) row[kTurn + i][j] = forward ? turn.m[j][i] : turn.m[i][j];
    if (!forward) continue;
    row[kShift] = load_three(nodes.motion + 7 * s);
    for (int64_t k = 0; k < fours(nodes.width); ++k)
      row[kValues + k] = load_some(nodes.values + s * nodes.width + 4 * k, nodes.width - 4 * k);
  }
  return table;
}

// The exponents of one point's weights, as powers of two, the largest 0. Distances that overflow all count as equal.
template <class S>
inline void exponents(const Table<S>& table, const S* coords, const int64_t* followed, int64_t num_nodes, S* to) {
  const Four<S> x = load_three(coords);
  S top = std::numeric_limits<S>::lowest();
  for (int64_t b = 0; b < num_nodes; ++b) {
    const Four<S> place = table[followed[b]][kPlace];
    to[b] = weight_exponent(x - place, place[3]);
    top = top < to[b] ? to[b] : top;
  }
  for (int64_t b = 0; b < num_nodes; ++b) to[b] -= top;
}

// 2^x in place; NaN stays.
template <class S>
void exponentiate(S* values, int64_t count) {
  const auto power = [](Packet<S> x) { return select(x == x, exp2(x), x); };
  int64_t i = 0;
  for (; i + kLanes <= count; i += kLanes) power(Packet<S>::load(values + i)).store(values + i);
  if (i == count) return;
  S rest[kLanes] = {};
  std::copy(values + i, values + count, rest);
  power(Packet<S>::load(rest)).store(rest);
  std::copy(rest, rest + (count - i), values + i);
}

template <class S>
inline void normalize_weights(S* weights, int64_t count) {
  S total = 0;
  for (int64_t b = 0; b < count; ++b) total += weights[b];
  const S inverse = S(1) / total;
  for (int64_t b = 0; b < count; ++b) weights[b] *= inverse;
}

template <class S>
inline void blend(const Table<S>& table, const S* coords, const int64_t* followed, int64_t num_nodes, const S* weights,
                  S* offset, S* blended, int64_t width) {
  const Four<S> x = load_three(coords);
  Four<S> sum(S(0));
  for (int64_t b = 0; b < num_nodes; ++b) {
    const Four<S>* row = table[followed[b]];
    sum += weights[b] * moved_by(row + kTurn, row[kShift], x - row[kPlace]);
  }
  store_some<S>(offset, sum, 3);
  for (int64_t k = 0; k < fours(width); ++k) {
    Four<S> values(S(0));
    for (int64_t b = 0; b < num_nodes; ++b) values += weights[b] * table[followed[b]][kValues + k];
    store_some<S>(blended + 4 * k, values, width - 4 * k);
  }
}

// Adds the gradients of the points [begin, end) to `sums`, a row per node, and writes the gradients by these points.
template <class S>
void gather_part(const Table<S>& table, const SkinPoints<S>& points, const Skinned<const S>& g, int64_t width,
                 int64_t begin, int64_t end, Four<S>* sums, S* g_points) {
  const int64_t stride = kByValues + fours(width);
  for (int64_t m = begin; m < end; ++m) {
    const int64_t* followed = points.followed + m * points.nodes;
    const S* weights = g.weights + m * points.nodes;
    const Four<S> x = load_three(points.coords + 3 * m), by_offset = load_three(g.offset + 3 * m);
    Four<S> by_point(S(0));
    for (int64_t b = 0; b < points.nodes; ++b) {
      const Four<S>* row = table[followed[b]];
      Four<S>* sum = sums + followed[b] * stride;
      const Four<S> arm = x - row[kPlace], share = weights[b] * by_offset;
      moved_by_vjp(row + kTurn, arm, share, sum + kByTurn, sum[kByShift], by_point);
    }
    if (g_points != nullptr) store_some<S>(g_points + 3 * m, by_point, 3);
    for (int64_t k = 0; k < fours(width); ++k) {
      const Four<S> by_values = load_some(g.blended + m * width + 4 * k, width - 4 * k);
      for (int64_t b = 0; b < points.nodes; ++b) sums[followed[b] * stride + kByValues + k] += weights[b] * by_values;
    }
  }
}

// The gradients of one node from the sum over all parts.
template <class S>
void write_node(const SkinNodes<S>& nodes, int64_t node, const Four<S>* sum, const SkinGrads<S>& grads) {
  Mat3<S> by_turn;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) by_turn.m[i][j] = sum[kByTurn + j][i];
  const Quat<S> by_quat = turn_vjp(quaternion(nodes, node), by_turn);
  S* to = grads.motion + 7 * node;
  store_some<S>(to, sum[kByShift], 3);
  store_some<S>(to + 3, four(by_quat.w, by_quat.x, by_quat.y, by_quat.z), 4);
  for (int64_t k = 0; k < fours(nodes.width); ++k)
    store_some<S>(grads.values + node * nodes.width + 4 * k, sum[kByValues + k], nodes.width - 4 * k);
}

// The number of parts: few where there are more nodes than points, as every part costs a pass over all nodes.
int64_t num_parts(int64_t num_points, int64_t per_point, int64_t num_nodes) {
  return std::clamp<int64_t>(num_points * per_point / std::max<int64_t>(4 * num_nodes, 1), 1, kMaxParts);
}

}  // namespace

bool follow_within(const int64_t* followed, int64_t size, int64_t num_nodes) {
  uint64_t largest = 0;  // negative indices are larger than any other
  for (int64_t i = 0; i < size; ++i) largest = std::max(largest, static_cast<uint64_t>(followed[i]));
  return size == 0 || largest < static_cast<uint64_t>(num_nodes);
}

template <class S>
void skinning_forward(const SkinNodes<S>& nodes, const SkinPoints<S>& points, const Skinned<S>& out, int threads) {
  const Table<S> table = node_table(nodes, true);
  const int64_t per_point = points.nodes;
  parallel_for(points.count, kGrain, threads, [&](int64_t begin, int64_t end) {
    for (int64_t m = begin; m < end; ++m)
      exponents(table, points.coords + 3 * m, points.followed + m * per_point, per_point, out.weights + m * per_point);
    exponentiate(out.weights + begin * per_point, (end - begin) * per_point);
    for (int64_t m = begin; m < end; ++m) {
      S* weights = out.weights + m * per_point;
      normalize_weights(weights, per_point);
      blend(table, points.coords + 3 * m, points.followed + m * per_point, per_point, weights, out.offset + 3 * m,
            out.blended + m * nodes.width, nodes.width);
    }
  });
}

template <class S>
void skinning_backward(const SkinNodes<S>& nodes, const SkinPoints<S>& points, const Skinned<const S>& g,
                       const SkinGrads<S>& grads, int threads) {
  const Table<S> table = node_table(nodes, false);
  const int64_t stride = kByValues + fours(nodes.width), size = nodes.count * stride;
  const int64_t parts = num_parts(points.count, points.nodes, nodes.count);
  const auto sums = std::make_unique_for_overwrite<Four<S>[]>(parts * size);
  parallel_for(parts, 1, threads, [&](int64_t part, int64_t) {
    Four<S>* own = sums.get() + part * size;
    std::fill(own, own + size, Four<S>(S(0)));
    gather_part(table, points, g, nodes.width, points.count * part / parts, points.count * (part + 1) / parts, own,
                grads.points);
  });
  parallel_for(nodes.count, kNodeGrain, threads, [&](int64_t begin, int64_t end) {
    for (int64_t part = 1; part < parts; ++part)
      for (int64_t i = begin * stride; i < end * stride; ++i) sums[i] += sums[part * size + i];
    for (int64_t s = begin; s < end; ++s) write_node(nodes, s, sums.get() + s * stride, grads);
  });
}

#define DYNGS_INSTANTIATE(S)                                                                          \
  template void skinning_forward(const SkinNodes<S>&, const SkinPoints<S>&, const Skinned<S>&, int);  \
  template void skinning_backward(const SkinNodes<S>&, const SkinPoints<S>&, const Skinned<const S>&, \
                                  const SkinGrads<S>&, int);
DYNGS_INSTANTIATE(float)
DYNGS_INSTANTIATE(double)
#undef DYNGS_INSTANTIATE

}  // namespace dyngs

// Control nodes at a time, and the penalties of their motion with their gradients (math/nodes.hpp). Sums over nodes are of
// one number per node, in order, so that they do not depend on the threads.
#include "core/api.hpp"

#include <algorithm>
#include <vector>

#include "cpu/parallel.hpp"
#include "cpu/simd.hpp"
#include "math/nodes.hpp"

namespace dyngs {
namespace {

constexpr int64_t kGrain = 128;  // nodes

template <class S>
S quat_gradient(int head, int64_t k, const S* by_motion) {
  return head == 1 ? by_motion[3 + k] : S(0);
}

// The second differences of a node's path, with zeros around them, so that every control point has three of them.
template <class S>
class Bends {
 public:
  explicit Bends(int64_t points) : size_(3 * (points - 2)), values_(size_ + kAround + kAround + kLanes) {}

  // Returns the sum of their squares.
  S take(const S* path) {
    S* to = values_.data() + kAround;
    for (int64_t i = 0; i < size_; ++i) to[i] = path[i] - 2 * path[i + 3] + path[i + 6];
    Packet<S> sum(S(0));
    for (int64_t i = 0; i < size_; i += kLanes) {
      const Packet<S> bend = Packet<S>::load(to + i);
      sum += bend * bend;
    }
    return horizontal_sum(sum);
  }

  // Writes the gradient of factor / 2 times the sum of squares by the path.
  void write_gradient(S factor, S* to) const {
    const S* from = values_.data();
    for (int64_t i = 0; i < size_ + kAround; ++i) to[i] = factor * (from[i + 6] - 2 * from[i + 3] + from[i]);
  }

 private:
  static constexpr int64_t kAround = 6;
  int64_t size_;
  std::vector<S> values_;
};

template <class S>
Vec3<S> arm_between(const NodeGraph<S>& graph, int64_t node, int64_t neighbour) {
  return load_vec3(graph.positions + 3 * neighbour) - load_vec3(graph.positions + 3 * node);
}

// The strain of one node with each neighbour, times factor, to `scaled` (B, 3), and the gradient by its own motion of
// factor / 2 times the sum of squares, which is returned without the factor.
template <class S>
S strain_of_node(const NodeGraph<S>& graph, int64_t node, S factor, S* scaled, S* by_motion) {
  const S* motion = graph.motion + 7 * node;
  const Quat<S> quat = load_quat(motion + 3);
  const Mat3<S> turn = turn_of(quat);
  Mat3<S> by_turn{};
  Vec3<S> by_shift{S(0), S(0), S(0)};
  S squares = 0;
  for (int64_t b = 0; b < graph.near; ++b) {
    const int64_t neighbour = graph.neighbours[node * graph.near + b];
    const Vec3<S> arm = arm_between(graph, node, neighbour);
    const Vec3<S> off = strain(turn, load_vec3(motion), arm, load_vec3(graph.motion + 7 * neighbour));
    const Vec3<S> g = off * factor;
    squares += dot(off, off);
    strain_vjp(arm, g, by_turn);
    by_shift = by_shift - g;
    scaled[3 * b] = g.x, scaled[3 * b + 1] = g.y, scaled[3 * b + 2] = g.z;
  }
  const Quat<S> by_quat = turn_vjp(quat, by_turn);
  by_motion[0] = by_shift.x, by_motion[1] = by_shift.y, by_motion[2] = by_shift.z;
  by_motion[3] = by_quat.w, by_motion[4] = by_quat.x, by_motion[5] = by_quat.y, by_motion[6] = by_quat.z;
  return squares;
}

}  // namespace

template <class S>
void nodes_at(const NodeSplines<S>& splines, S* motion, S* values, int threads) {
  int64_t width = 0;
  for (int h = 1; h < kHeads; ++h) width += splines.heads[h] ? head_size(h) : 0;
  parallel_for(splines.count, kGrain, threads, [&](int64_t begin, int64_t end) {
    for (int64_t s = begin; s < end; ++s) {
      S *row = motion + 7 * s, *value = values + width * s;
      for (int k = 3; k < 7; ++k) row[k] = S(k == 3);
      for (int h = 0; h < kHeads; ++h) {
        if (!splines.heads[h]) continue;
        const int64_t size = head_size(h);
        const S* at = splines.heads[h] + (s * splines.points + splines.first) * size;
        for (int64_t k = 0; k < size; ++k) {
          const S found = spline_value(at + k, size, splines.fractions);
          if (h == 0) row[k] = found;
          if (h == 1) row[3 + k] += found;
          if (h > 0) *value++ = found;
        }
      }
    }
  });
}

template <class S>
void nodes_at_backward(const NodeSplines<S>& splines, const S* by_motion, const S* by_values,
                       const SplineGrads<S>& grads, int threads) {
  int64_t width = 0, offset = 0;
  for (int h = 1; h < kHeads; ++h) width += splines.heads[h] ? head_size(h) : 0;
  for (int h = 0; h < kHeads; ++h) {
    if (!splines.heads[h]) continue;
    const int64_t size = head_size(h);
    parallel_for(splines.count, kGrain, threads, [&](int64_t begin, int64_t end) {
      std::fill(grads.heads[h] + begin * splines.points * size, grads.heads[h] + end * splines.points * size, S(0));
      for (int64_t s = begin; s < end; ++s) {
        S* to = grads.heads[h] + (s * splines.points + splines.first) * size;
        for (int64_t k = 0; k < size; ++k) {
          S g = h == 0 ? by_motion[7 * s + k] : quat_gradient(h, k, by_motion + 7 * s);
          if (h > 0 && by_values) g += by_values[width * s + offset + k];
          for (int i = 0; i < 4; ++i) to[i * size + k] = splines.fractions[i] * g;
        }
      }
    });
    if (h > 0) offset += size;
  }
}

template <class S>
void node_penalties(const NodeGraph<S>& graph, double* penalties, S* by_paths, S* by_motion, int threads) {
  const int64_t path = 3 * graph.points;
  const double bends = double(graph.count) * double(path - 6), strains = double(graph.count) * double(graph.near);
  std::vector<double> squares(2 * graph.count);
  std::vector<S> scaled(3 * graph.count * graph.near);
  parallel_for(graph.count, kGrain, threads, [&](int64_t begin, int64_t end) {
    Bends<S> node_bends(graph.points);
    for (int64_t s = begin; s < end; ++s) {
      const double weight = 1 / (double(graph.radii[s]) * graph.radii[s]);
      squares[2 * s] = weight * node_bends.take(graph.paths + path * s);
      node_bends.write_gradient(S(2 * weight / bends), by_paths + path * s);
      squares[2 * s + 1] = weight * strain_of_node(graph, s, S(2 * weight / strains),
                                                   scaled.data() + 3 * graph.near * s, by_motion + 7 * s);
    }
  });
  penalties[0] = penalties[1] = 0;
  for (int64_t s = 0; s < graph.count; ++s) {
    penalties[0] += squares[2 * s] / bends;
    penalties[1] += squares[2 * s + 1] / strains;
  }
  for (int64_t i = 0; i < graph.count * graph.near; ++i)  // in order: several nodes may have the same neighbour
    for (int k = 0; k < 3; ++k) by_motion[7 * graph.neighbours[i] + k] += scaled[3 * i + k];
}

#define DYNGS_INSTANTIATE(S)                                                                              \
  template void nodes_at(const NodeSplines<S>&, S*, S*, int);                                             \
  template void nodes_at_backward(const NodeSplines<S>&, const S*, const S*, const SplineGrads<S>&, int); \
  template void node_penalties(const NodeGraph<S>&, double*, S*, S*, int);
DYNGS_INSTANTIATE(float)
DYNGS_INSTANTIATE(double)
#undef DYNGS_INSTANTIATE

}  // namespace dyngs

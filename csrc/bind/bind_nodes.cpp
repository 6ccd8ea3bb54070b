// Python bindings of control nodes. Argument unpacking only.
#include "bind/arrays.hpp"
#include "core/api.hpp"
#include "math/nodes.hpp"

namespace dyngs {
namespace {

template <class S>
using Splines = nb::ndarray<S, nb::c_contig, Device, nb::ndim<3>>;
template <class S>
using Heads = std::tuple<Splines<S>, std::optional<Splines<S>>, std::optional<Splines<S>>, std::optional<Splines<S>>,
                         std::optional<Splines<S>>>;

constexpr const char* kOp = "nodes";

template <class S>
S* head_of(const Splines<S>& head, int which, size_t count, size_t points) {
  if (head.shape(0) != count || head.shape(1) != points || static_cast<int64_t>(head.shape(2)) != head_size(which))
    throw nb::value_error("nodes: arrays of different sizes");
  return head.data();
}
template <class S>
S* head_of(const std::optional<Splines<S>>& head, int which, size_t count, size_t points) {
  return head ? head_of<S>(*head, which, count, points) : nullptr;
}

// Fills `to` with the pointers of heads of (count, points, head_size).
template <class S>
void take_heads(const Heads<S>& heads, size_t count, size_t points, S* (&to)[kHeads]) {
  const auto& [first, second, third, fourth, fifth] = heads;
  to[0] = head_of<S>(first, 0, count, points), to[1] = head_of<S>(second, 1, count, points);
  to[2] = head_of<S>(third, 2, count, points), to[3] = head_of<S>(fourth, 3, count, points);
  to[4] = head_of<S>(fifth, 4, count, points);
}

using Place = std::tuple<int64_t, double, double, double, double>;  // the first control point, and four fractions

template <class S>
NodeSplines<S> splines_input(const Heads<const S>& heads, const Place& place) {
  const auto [first, a, b, c, d] = place;
  const size_t count = std::get<0>(heads).shape(0), points = std::get<0>(heads).shape(1);
  NodeSplines<S> splines{{},
                         static_cast<int64_t>(count),
                         static_cast<int64_t>(points),
                         first,
                         {static_cast<S>(a), static_cast<S>(b), static_cast<S>(c), static_cast<S>(d)}};
  take_heads<const S>(heads, count, points, splines.heads);
  if (first < 0 || first + 4 > splines.points) throw nb::index_error("nodes: no such control points");
  return splines;
}

template <class S>
int64_t width_of(const NodeSplines<S>& splines) {
  int64_t width = 0;
  for (int h = 1; h < kHeads; ++h) width += splines.heads[h] ? head_size(h) : 0;
  return width;
}

template <class S>
void nodes_at_arrays(const Heads<const S>& heads, const Place& place, const Rows<S>& motion, const Rows<S>& values,
                     int threads) {
  const NodeSplines<S> splines = splines_input<S>(heads, place);
  if (splines.count == 0) return;  // and so no pointers
  S *to = checked(motion, splines.count, 7, kOp), *also = checked(values, splines.count, width_of(splines), kOp);
  nb::gil_scoped_release release;
  nodes_at(splines, to, also, threads);
}

template <class S>
void nodes_at_backward_arrays(const Heads<const S>& heads, const Place& place, const Rows<const S>& by_motion,
                              const std::optional<Rows<const S>>& by_values, const Heads<S>& g_heads, int threads) {
  const NodeSplines<S> splines = splines_input<S>(heads, place);
  if (splines.count == 0) return;
  SplineGrads<S> grads{};
  take_heads<S>(g_heads, splines.count, splines.points, grads.heads);
  for (int h = 0; h < kHeads; ++h)
    if (!grads.heads[h] != !splines.heads[h]) throw nb::value_error("nodes: heads without gradients");
  const S* motion = checked(by_motion, splines.count, 7, kOp);
  const S* values = checked(by_values, splines.count, width_of(splines), kOp);
  nb::gil_scoped_release release;
  nodes_at_backward(splines, motion, values, grads, threads);
}

template <class S>
void node_penalties_arrays(const std::tuple<Rows<const S>, Array<const S, nb::ndim<1>>, Rows<const int64_t>>& nodes,
                           const Rows<const S>& motion, const Splines<const S>& paths,
                           const std::tuple<Array<double, nb::shape<2>>, Splines<S>, Rows<S>>& out, int threads) {
  const auto& [positions, radii, neighbours] = nodes;
  const auto& [penalties, by_paths, by_motion] = out;
  const int64_t count = radii.shape(0), near = neighbours.shape(1), points = paths.shape(1);
  const NodeGraph<S> graph{checked(positions, count, 3, kOp),
                           radii.data(),
                           checked(neighbours, count, near, kOp),
                           checked(motion, count, 7, kOp),
                           head_of<const S>(paths, 0, count, points),
                           count,
                           near,
                           points};
  if (points < 4) throw nb::value_error("nodes: too few control points");
  if (!kOnGpu && !follow_within(neighbours.data(), count * near, count)) throw nb::index_error("nodes: no such node");
  S *paths_to = head_of<S>(by_paths, 0, count, points), *motion_to = checked(by_motion, count, 7, kOp);
  nb::gil_scoped_release release;
  node_penalties(graph, penalties.data(), paths_to, motion_to, threads);
}

}  // namespace

void bind_nodes(nb::module_& module) {
  for_each_scalar([&]<class S>() {
    module.def("nodes_at", nodes_at_arrays<S>);
    module.def("nodes_at_backward", nodes_at_backward_arrays<S>);
    module.def("node_penalties", node_penalties_arrays<S>);
  });
}

}  // namespace dyngs

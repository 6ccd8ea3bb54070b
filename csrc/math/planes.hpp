// Look-up in factored space-time grids (HexPlane, Cao and Johnson 2023; K-Planes, Fridovich-Keil et al. 2023): linear
// interpolation between samples, the product of three planes over space and three lines over time, and the penalties of the
// planes. V is one channel or the lanes of several, S a weight.
#pragma once

#include "math/scalar.hpp"

namespace dyngs {

// The position of a coordinate between samples: index (as a real) and fraction.
template <class R>
struct Cell {
  R index, frac;
};

// Of a coordinate u in [-1, 1], what lies outside clamped, on `size` samples. NaN gives index 0 and stays in the fraction.
template <class R>
DYNGS_HD Cell<R> locate(R u, int64_t size) {
  using S = Scalar<R>;
  const R zero = real<R>(0), one = real<R>(1);
  const R half(static_cast<S>(size - 1) / 2), last(static_cast<S>(size > 2 ? size - 2 : 0));
  u = select(u < -one, -one, select(u > one, one, u));
  const R x = u * half + half;
  const R index = trunc(min(select(x >= one, x, zero), last));
  return {index, x - index};
}

// Gradient by the coordinate from that by index + fraction: 0 where the coordinate was clamped.
template <class S>
DYNGS_HD S locate_vjp(S u, int64_t size, S g) {
  return u <= S(-1) || u >= S(1) ? S(0) : static_cast<S>(size - 1) / 2 * g;
}

// Two neighbouring rows of the time planes and where the time lies between them.
struct TimeRows {
  int64_t first, second;
  double weight;  // of the second
};

DYNGS_HD inline TimeRows time_rows(double time, int64_t times) {
  const double x = (time < 0.0 ? 0.0 : 1.0 < time ? 1.0 : time) * static_cast<double>(times - 1);
  const int64_t last = times > 2 ? times - 2 : 0, below = static_cast<int64_t>(x);
  const int64_t first = below < last ? below : last, next = first + 1;
  return {first, next < times - 1 ? next : times - 1, x - static_cast<double>(first)};
}

// Phrased as a + b * c, so that the compiler has no choice which product to fuse.
template <class V, class S>
DYNGS_HD V lerp(const V& a, const V& b, S t) {
  return a + V(t) * (b - a);
}

// A plane's value from its four samples, and its slopes by the two fractions.
template <class V>
struct PlaneValue {
  V value, by_fast, by_slow;
};

// Samples a b of the first row, c d of the second; x along the rows, y from row to row.
template <class V, class S>
DYNGS_HD V bilinear(const V& a, const V& b, const V& c, const V& d, S x, S y) {
  return lerp(lerp(a, b, x), lerp(c, d, x), y);
}

template <class V, class S>
DYNGS_HD PlaneValue<V> bilinear_slopes(const V& a, const V& b, const V& c, const V& d, S x, S y) {
  const V top = lerp(a, b, x), by_slow = lerp(c, d, x) - top;
  return {top + V(y) * by_slow, lerp(V(b - a), V(d - c), y), by_slow};
}

// Weights of the four samples a b c d.
template <class R>
DYNGS_HD void bilinear_weights(R x, R y, R (&weight)[4]) {
  const R one = real<R>(1);
  weight[0] = (one - x) * (one - y);
  weight[1] = x * (one - y);
  weight[2] = (one - x) * y;
  weight[3] = x * y;
}

// A feature: the product of the three planes xy, xz, yz and of the three lines x, y, z.
template <class V>
DYNGS_HD V plane_product(const V (&plane)[3], const V (&line)[3]) {
  return (plane[0] * plane[1] * plane[2]) * (line[0] * line[1] * line[2]);
}

template <class V>
DYNGS_HD void plane_product_vjp(const PlaneValue<V> (&plane)[3], const V (&line)[3], const V& g, V (&g_plane)[3],
                                V (&g_line)[3]) {
  const V &p0 = plane[0].value, &p1 = plane[1].value, &p2 = plane[2].value;
  const V g_planes = g * (line[0] * line[1] * line[2]), g_lines = g * (p0 * p1 * p2);
  g_plane[0] = g_planes * (p1 * p2);
  g_plane[1] = g_planes * (p0 * p2);
  g_plane[2] = g_planes * (p0 * p1);
  g_line[0] = g_lines * (line[1] * line[2]);
  g_line[1] = g_lines * (line[0] * line[2]);
  g_line[2] = g_lines * (line[0] * line[1]);
}

// Gradients by the three coordinates, in samples; `by_line`: the lines' slopes.
template <class V>
DYNGS_HD void coordinate_vjp(const PlaneValue<V> (&plane)[3], const V (&by_line)[3], const V (&g_plane)[3],
                             const V (&g_line)[3], V (&g)[3]) {
  g[0] = dot3(g_plane[0], plane[0].by_fast, g_plane[1], plane[1].by_fast, g_line[0], by_line[0]);
  g[1] = dot3(g_plane[0], plane[0].by_slow, g_plane[2], plane[2].by_fast, g_line[1], by_line[1]);
  g[2] = dot3(g_plane[1], plane[1].by_slow, g_plane[2], plane[2].by_slow, g_line[2], by_line[2]);
}

// The factors of a plane's three sums: of squared second differences from row to row, and from column to column, and of |p - 1|.
struct PenaltyFactors {
  double by_rows, by_columns, one;
};

// Turns a sum of `count` numbers into weight times their mean; 0 if there are none.
DYNGS_HD inline double mean_factor(double weight, int64_t count) {
  return count > 0 ? weight / static_cast<double>(count) : 0;
}

// Of a plane over space (size, size, C): the mean over both axes.
DYNGS_HD inline PenaltyFactors space_factors(double weight, int64_t size, int64_t channels) {
  const double square = mean_factor(weight / 2, (size > 2 ? size - 2 : 0) * size * channels);
  return {square, square, 0};
}

// Of a plane over time (times, size, C): along time, and the distance from one.
DYNGS_HD inline PenaltyFactors time_factors(double weight, double one, int64_t times, int64_t size, int64_t channels) {
  const int64_t row = size * channels;
  return {mean_factor(weight, (times > 2 ? times - 2 : 0) * row), 0, mean_factor(one, times * row)};
}

// The penalties: d_i = p_(i-1) - 2 p_i + p_(i+1), squared, and |p - 1|.
template <class R>
DYNGS_HD R second_difference(R a, R b, R c) {
  return (a - b) + (c - b);
}

// Gradient of sum_i d_i^2 by p_i times factor / 2, of the differences around i.
template <class R>
DYNGS_HD R second_difference_vjp(R before, R at, R after, R factor) {
  return factor * (before + after - real<R>(2) * at);
}

// Gradient of |d| times factor.
template <class R>
DYNGS_HD R distance_vjp(R d, R factor) {
  const R zero = real<R>(0);
  return select(d > zero, factor, select(d < zero, -factor, zero));
}

}  // namespace dyngs

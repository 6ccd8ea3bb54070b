// A Gaussian under a linear map T: its covariance T S T^T as rotation and log scales again, exactly, and the vjp.
//
// With S = R diag(s^2) R^T the matrix M = T R diag(s) has the singular value decomposition U diag(d) V^T, and the
// covariance is U diag(d^2) U^T. One-sided Jacobi (Hestenes 1958) turns the columns of M until they are orthogonal, which
// finds short axes as exactly as long ones; no square of M is formed. Columns that are orthogonal already, as those of a
// rigid map are, stay as they are. s is taken relative to the longest axis, at least e^-16 of it.
//
// The derivative of U divides by d_i^2 - d_j^2. Where these are nearly equal, the numerator vanishes for whatever depends on
// the covariance alone, and the quotient is set to zero.
#pragma once

#include "math/quaternion.hpp"

namespace dyngs {

// Natural logarithm and value of the smallest ratio of a Gaussian's axes that is distinguished from zero.
inline constexpr double kThinnestLog = -16, kThinnest = 1.1253517471925912e-07;
// Relative gap of two squared axes below which turning one into the other has no visible effect.
inline constexpr double kClosestAxes = 1e-4;
// Limit on the sweeps of Jacobi's method, which converges quadratically: rigid maps need one, others two to four.
inline constexpr int kMaxSweeps = 8;

// Length of an axis, relative to the longest at rest, that counts as zero; its square is a normal number.
template <class S>
inline constexpr S kVanishing = S(sizeof(S) == 4 ? 1e-18 : 1e-150);

// A Gaussian at rest: a unit quaternion with its matrix, and axes relative to the longest.
template <class R>
struct RestShape {
  Quat<R> unit;
  R inv_norm;
  Mat3<R> rotation;
  R length[3];
  R longest;           // its logarithm
  MaskOf<R> thick[3];  // not shorter than the thinnest that is distinguished
};

// NaN in the quaternion or in the scales makes the lengths NaN.
template <class R>
DYNGS_HD RestShape<R> rest_shape(const Quat<R>& q, const R (&log_scales)[3]) {
  const R zero = real<R>(0), lowest = real<R>(kThinnestLog);
  RestShape<R> s;
  s.unit = normalize(q, s.inv_norm);
  s.rotation = rotation_matrix(s.unit);
  const R nothing = q.w * zero + q.x * zero + q.y * zero + q.z * zero;  // or NaN
  s.longest = max(log_scales[0], max(log_scales[1], log_scales[2]));
  for (int k = 0; k < 3; ++k) {
    const R ratio = log_scales[k] - s.longest;
    s.thick[k] = lowest <= ratio;
    const R exponent = select(ratio < lowest, lowest, ratio) * real<R>(1.4426950408889634);
    s.length[k] = exp2(exponent) + (nothing + exponent * zero);
  }
  return s;
}

template <class R>
struct Decomposition {
  Mat3<R> axes;    // U, a rotation; some rotation where there are fewer than two axes
  R length[3];     // d, in no order
  Mat3<R> turned;  // V
};

// Turns the columns p and q of M and of V into each other so that those of M become orthogonal. Returns where they were so
// far from it that the other columns have to be looked at again.
template <int p, int q, class R>
DYNGS_HD MaskOf<R> orthogonalize(Mat3<R>& columns, Mat3<R>& turned) {
  constexpr double eps = kEpsilon<Scalar<R>>;
  auto& m = columns.m;
  auto& v = turned.m;
  const R a = dot3(m[0][p], m[0][p], m[1][p], m[1][p], m[2][p], m[2][p]);
  const R b = dot3(m[0][q], m[0][q], m[1][q], m[1][q], m[2][q], m[2][q]);
  const R c = dot3(m[0][p], m[0][q], m[1][p], m[1][q], m[2][p], m[2][q]);
  const auto orthogonal = c * c <= a * b * real<R>(16 * eps * eps);  // not if there is a NaN, which then spreads
  if (any(!orthogonal)) {
    const R zero = real<R>(0), one = real<R>(1), gap = b - a, twice = c + c;
    const R least = real<R>(kVanishing<Scalar<R>> * kVanishing<Scalar<R>>);
    const R spread = abs(gap) + sqrt(gap * gap + twice * twice);
    const R tangent =
        select(orthogonal, zero, select(gap < zero, -twice, twice) / select(spread < least, least, spread));
    const R cosine = one / sqrt(one + tangent * tangent), sine = tangent * cosine;
    for (int i = 0; i < 3; ++i) {
      const R x = m[i][p], y = m[i][q], z = v[i][p], w = v[i][q];
      m[i][p] = cosine * x - sine * y, m[i][q] = sine * x + cosine * y;
      v[i][p] = cosine * z - sine * w, v[i][q] = sine * z + cosine * w;
    }
  }
  return a * b * real<R>(eps) < c * c;
}

template <class R>
DYNGS_HD Vec3<R> cross(const Vec3<R>& a, const Vec3<R>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class M, class R>
DYNGS_HD Vec3<R> select(const M& condition, const Vec3<R>& a, const Vec3<R>& b) {
  return {select(condition, a.x, b.x), select(condition, a.y, b.y), select(condition, a.z, b.z)};
}

// Of M. A vanishing axis is where the other two leave it.
template <class R>
DYNGS_HD Decomposition<R> decompose(const Mat3<R>& matrix) {
  const R zero = real<R>(0), one = real<R>(1), vanishing = real<R>(kVanishing<Scalar<R>>);
  Mat3<R> columns = matrix;
  Decomposition<R> d;
  d.turned = {{{one, zero, zero}, {zero, one, zero}, {zero, zero, one}}};
  for (int sweep = 0; sweep < kMaxSweeps; ++sweep) {
    const MaskOf<R> first = orthogonalize<0, 1>(columns, d.turned);
    const MaskOf<R> second = orthogonalize<0, 2>(columns, d.turned);
    const MaskOf<R> third = orthogonalize<1, 2>(columns, d.turned);
    if (!any(first | second | third)) break;
  }
  Vec3<R> u[3];
  MaskOf<R> vanishes[3];
  for (int k = 0; k < 3; ++k) {
    u[k] = {columns.m[0][k], columns.m[1][k], columns.m[2][k]};
    const R length = norm(u[k]);
    vanishes[k] = length < vanishing;
    d.length[k] = select(vanishes[k], vanishing, length);
    u[k] = u[k] * (one / d.length[k]);
  }
  u[0] = select(vanishes[0], cross(u[1], u[2]), u[0]);
  u[1] = select(vanishes[1], cross(u[2], u[0]), u[1]);
  const Vec3<R> last = cross(u[0], u[1]);
  const R sign = select(dot(last, u[2]) < zero, -one, one);  // T reflects
  for (int i = 0; i < 3; ++i) d.turned.m[i][2] = d.turned.m[i][2] * sign;
  u[2] = select(dot(last, last) < real<R>(0.5), u[2], last);
  d.axes = {{{u[0].x, u[1].x, u[2].x}, {u[0].y, u[1].y, u[2].y}, {u[0].z, u[1].z, u[2].z}}};
  return d;
}

// The unit quaternion of a rotation, its largest component positive: the column of 4 q q^T with the largest diagonal entry,
// normalised (Shepperd 1978). A matrix whose only columns other than zero are those of a rotation gives a rotation with these.
template <class R>
DYNGS_HD Quat<R> quat_of_rotation(const Mat3<R>& rotation) {
  const auto& m = rotation.m;
  const R one = real<R>(1);
  const R wx = m[2][1] - m[1][2], wy = m[0][2] - m[2][0], wz = m[1][0] - m[0][1];
  const R xy = m[0][1] + m[1][0], xz = m[0][2] + m[2][0], yz = m[1][2] + m[2][1];
  const R xx = one + m[0][0] - m[1][1] - m[2][2], yy = one - m[0][0] + m[1][1] - m[2][2];
  const R zz = one - m[0][0] - m[1][1] + m[2][2];
  R largest = one + m[0][0] + m[1][1] + m[2][2];
  Quat<R> q{largest, wx, wy, wz};
  const auto prefer = [&](R diagonal, const Quat<R>& other) {
    const auto better = largest < diagonal;
    largest = select(better, diagonal, largest);
    q = {select(better, other.w, q.w), select(better, other.x, q.x), select(better, other.y, q.y),
         select(better, other.z, q.z)};
  };
  prefer(xx, {wx, xx, xy, xz}), prefer(yy, {wy, xy, yy, yz}), prefer(zz, {wz, xz, yz, zz});
  const R inverse = one / sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
  return {q.w * inverse, q.x * inverse, q.y * inverse, q.z * inverse};
}

// The gradient by a small turn w in q (1, w / 2), from that by the unit quaternion.
template <class R>
DYNGS_HD Vec3<R> turn_about_axes_vjp(const Quat<R>& q, const Quat<R>& g) {
  const R half = real<R>(0.5);
  return {half * (q.w * g.x - q.x * g.w + q.z * g.y - q.y * g.z),
          half * (q.w * g.y - q.y * g.w + q.x * g.z - q.z * g.x),
          half * (q.w * g.z - q.z * g.w + q.y * g.x - q.x * g.y)};
}

template <class R>
DYNGS_HD Mat3<R> product(const Mat3<R>& a, const Mat3<R>& b) {
  Mat3<R> c;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) c.m[i][j] = dot3(a.m[i][0], b.m[0][j], a.m[i][1], b.m[1][j], a.m[i][2], b.m[2][j]);
  return c;
}
template <class R>
DYNGS_HD Mat3<R> transposed(const Mat3<R>& a) {
  Mat3<R> b;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) b.m[i][j] = a.m[j][i];
  return b;
}

// R diag(s).
template <class R>
DYNGS_HD Mat3<R> rest_axes(const RestShape<R>& shape) {
  Mat3<R> axes;
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k) axes.m[i][k] = shape.rotation.m[i][k] * shape.length[k];
  return axes;
}

template <class R>
struct MovedShape {
  Quat<R> quat;     // U
  R log_scales[3];  // log d
  R length[3];      // d, relative to the longest axis at rest
  Mat3<R> turned;   // V
};

template <class R>
DYNGS_HD MovedShape<R> move_shape(const Mat3<R>& linear, const RestShape<R>& shape) {
  const Decomposition<R> d = decompose(product(linear, rest_axes(shape)));
  MovedShape<R> moved;
  moved.quat = quat_of_rotation(d.axes);
  for (int k = 0; k < 3; ++k) {
    moved.length[k] = d.length[k];
    moved.log_scales[k] = log(d.length[k]) + shape.longest;
  }
  moved.turned = d.turned;
  return moved;
}

// The gradient by M, U X V^T with X_ij = (S_ij - S_ji) d_j / (d_j^2 - d_i^2), S = U^T g_U, and X_kk = g_k / d_k; finite for
// any d. Lengths below e^-16 of the longest count as that.
template <class R>
DYNGS_HD Mat3<R> decompose_vjp(const MovedShape<R>& moved, const Quat<R>& g_quat, const R (&g_logs)[3]) {
  const R zero = real<R>(0), one = real<R>(1);
  const R top = max(moved.length[0], max(moved.length[1], moved.length[2]));
  const R inverse = select(top <= real<R>(kVanishing<Scalar<R>>), zero, one / top);
  const Vec3<R> turn = turn_about_axes_vjp(moved.quat, g_quat);
  const R twist[3][3] = {{zero, -turn.z, turn.y}, {turn.z, zero, -turn.x}, {-turn.y, turn.x, zero}};
  R length[3], square[3];
  for (int k = 0; k < 3; ++k) {
    length[k] = max(moved.length[k] * inverse, real<R>(kThinnest));
    square[k] = length[k] * length[k];
  }
  Mat3<R> inner;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      if (i == j) {
        inner.m[i][i] = inverse * g_logs[i] / length[i];
        continue;
      }
      const R gap = square[j] - square[i];
      const auto apart = real<R>(kClosestAxes) * max(square[i], square[j]) < abs(gap);
      inner.m[i][j] = select(apart, inverse * twist[i][j] * length[j] / select(apart, gap, one), zero);
    }
  return product(product(rotation_matrix(moved.quat), inner), transposed(moved.turned));
}

template <class R>
struct MovedShapeGrad {
  Mat3<R> linear;
  Quat<R> quat;
  R log_scales[3];
};

// Of `moved` only the log scales are not read.
template <class R>
DYNGS_HD MovedShapeGrad<R> move_shape_vjp(const Mat3<R>& linear, const RestShape<R>& shape, const MovedShape<R>& moved,
                                          const Quat<R>& g_quat, const R (&g_logs)[3]) {
  const R zero = real<R>(0);
  const Mat3<R> by_matrix = decompose_vjp(moved, g_quat, g_logs);
  MovedShapeGrad<R> g;
  g.linear = product(by_matrix, transposed(rest_axes(shape)));
  const Mat3<R> by_axes = product(transposed(linear), by_matrix);
  Mat3<R> by_rotation;
  R follows = zero;  // thin axes are a share of the longest
  for (int k = 0; k < 3; ++k) {
    R by_length = zero;
    for (int i = 0; i < 3; ++i) {
      by_length = by_length + by_axes.m[i][k] * shape.rotation.m[i][k];
      by_rotation.m[i][k] = by_axes.m[i][k] * shape.length[k];
    }
    const R by_log = by_length * shape.length[k];
    g.log_scales[k] = select(shape.thick[k], by_log, zero);
    follows = follows + (by_log - g.log_scales[k]);
  }
  const MaskOf<R> first = (shape.length[1] <= shape.length[0]) & (shape.length[2] <= shape.length[0]);
  const MaskOf<R> second = (!first) & (shape.length[2] <= shape.length[1]);
  g.log_scales[0] = g.log_scales[0] + select(first, follows, zero);
  g.log_scales[1] = g.log_scales[1] + select(second, follows, zero);
  g.log_scales[2] = g.log_scales[2] + select(first | second, zero, follows);
  g.quat = normalize_vjp(shape.unit, shape.inv_norm, rotation_matrix_vjp(shape.unit, by_rotation));
  return g;
}

// T x + t.
template <class R>
DYNGS_HD Vec3<R> moved_point(const Mat3<R>& linear, const Vec3<R>& shift, const Vec3<R>& x) {
  return linear * x + shift;
}

// The gradient by x; adds g x^T to that by T. That by t is g.
template <class R>
DYNGS_HD Vec3<R> moved_point_vjp(const Mat3<R>& linear, const Vec3<R>& x, const Vec3<R>& g, Mat3<R>& by_linear) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) by_linear.m[i][j] = by_linear.m[i][j] + g[i] * x[j];
  return transposed_times(linear, g);
}

}  // namespace dyngs

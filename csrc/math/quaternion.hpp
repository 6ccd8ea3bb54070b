// Rotations as quaternions (w, x, y, z) and as matrices, and their vjps.
#pragma once

#include "math/vec.hpp"

namespace dyngs {

template <class R>
struct Quat {
  R w, x, y, z;
};

template <class R>
DYNGS_HD Quat<R> load_quat(const R* p) {
  return {p[0], p[1], p[2], p[3]};
}

// Unit quaternion along q. Scaled by the largest entry first, so neither 1e30 nor denormals over- or underflow.
// A zero (or NaN) quaternion gives the identity. `inv_norm` is 1/|q|, at most 1e12, for the vjp (0 for the identity).
template <class R>
DYNGS_HD Quat<R> normalize(const Quat<R>& q, R& inv_norm) {
  const R zero = real<R>(0), one = real<R>(1);
  const R largest = max(max(abs(q.w), abs(q.x)), max(abs(q.y), abs(q.z)));
  const auto valid = largest > zero;
  const R scale = select(valid, largest, one);
  const R w = select(valid, q.w / scale, one), x = select(valid, q.x / scale, zero);
  const R y = select(valid, q.y / scale, zero), z = select(valid, q.z / scale, zero);
  const R inv = one / sqrt(w * w + x * x + y * y + z * z);
  inv_norm = select(valid, inv / max(scale, real<R>(1e-12)), zero);
  return {w * inv, x * inv, y * inv, z * inv};
}

// Tangent projection: v_q = (v_n - n <n, v_n>) / |q|.
template <class R>
DYNGS_HD Quat<R> normalize_vjp(const Quat<R>& n, R inv_norm, const Quat<R>& g) {
  const R along = n.w * g.w + n.x * g.x + n.y * g.y + n.z * g.z;
  return {(g.w - n.w * along) * inv_norm, (g.x - n.x * along) * inv_norm, (g.y - n.y * along) * inv_norm,
          (g.z - n.z * along) * inv_norm};
}

// The Hamilton product: the rotation b, then a.
template <class R>
DYNGS_HD Quat<R> operator*(const Quat<R>& a, const Quat<R>& b) {
  return {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
          a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
}

template <class R>
DYNGS_HD Quat<R> conjugate(const Quat<R>& q) {
  return {q.w, -q.x, -q.y, -q.z};
}

// Of a unit quaternion.
template <class R>
DYNGS_HD Mat3<R> rotation_matrix(const Quat<R>& q) {
  const R one = real<R>(1), two = real<R>(2);
  Mat3<R> r;
  r.m[0][0] = one - two * (q.y * q.y + q.z * q.z);
  r.m[0][1] = two * (q.x * q.y - q.w * q.z);
  r.m[0][2] = two * (q.x * q.z + q.w * q.y);
  r.m[1][0] = two * (q.x * q.y + q.w * q.z);
  r.m[1][1] = one - two * (q.x * q.x + q.z * q.z);
  r.m[1][2] = two * (q.y * q.z - q.w * q.x);
  r.m[2][0] = two * (q.x * q.z - q.w * q.y);
  r.m[2][1] = two * (q.y * q.z + q.w * q.x);
  r.m[2][2] = one - two * (q.x * q.x + q.y * q.y);
  return r;
}

// The same minus the identity, whose diagonal would suffer from rounding if 1 were added and subtracted again.
template <class R>
DYNGS_HD Mat3<R> rotation_minus_identity(const Quat<R>& q) {
  const R minus_two = real<R>(-2);
  Mat3<R> r = rotation_matrix(q);
  r.m[0][0] = minus_two * (q.y * q.y + q.z * q.z);
  r.m[1][1] = minus_two * (q.x * q.x + q.z * q.z);
  r.m[2][2] = minus_two * (q.x * q.x + q.y * q.y);
  return r;
}

// Gradient by the unit quaternion from that by the matrix (or by the matrix minus the identity).
template <class R>
DYNGS_HD Quat<R> rotation_matrix_vjp(const Quat<R>& q, const Mat3<R>& g) {
  const R two = real<R>(2);
  const auto& m = g.m;
  return {two * (q.x * (m[2][1] - m[1][2]) + q.y * (m[0][2] - m[2][0]) + q.z * (m[1][0] - m[0][1])),
          two * (q.w * (m[2][1] - m[1][2]) + q.y * (m[0][1] + m[1][0]) + q.z * (m[0][2] + m[2][0]) -
                 two * q.x * (m[1][1] + m[2][2])),
          two * (q.w * (m[0][2] - m[2][0]) + q.x * (m[0][1] + m[1][0]) + q.z * (m[1][2] + m[2][1]) -
                 two * q.y * (m[0][0] + m[2][2])),
          two * (q.w * (m[1][0] - m[0][1]) + q.x * (m[0][2] + m[2][0]) + q.y * (m[1][2] + m[2][1]) -
                 two * q.z * (m[0][0] + m[1][1]))};
}

}  // namespace dyngs

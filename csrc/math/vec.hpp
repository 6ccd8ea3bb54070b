// Vectors of two and three numbers and 3x3 matrices, over a scalar or a vector of lanes.
#pragma once

#include "math/scalar.hpp"

namespace dyngs {

template <class R>
struct Vec2 {
  R x, y;
};

template <class R>
struct Vec3 {
  R x, y, z;

  DYNGS_INLINE R operator[](int i) const { return i == 0 ? x : i == 1 ? y : z; }
};

template <class R>
struct ScalarOf<Vec3<R>> {
  using type = Scalar<R>;
};

// Row-major: m[row][column].
template <class R>
struct Mat3 {
  R m[3][3];
};

template <class R>
DYNGS_INLINE Vec3<R> operator+(const Vec3<R>& a, const Vec3<R>& b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class R>
DYNGS_INLINE Vec3<R> operator-(const Vec3<R>& a, const Vec3<R>& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class R>
DYNGS_INLINE Vec3<R> operator*(const Vec3<R>& a, R s) {
  return {a.x * s, a.y * s, a.z * s};
}

template <class R>
DYNGS_INLINE R dot(const Vec3<R>& a, const Vec3<R>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

template <class R>
DYNGS_INLINE Vec3<R> load_vec3(const R* p) {
  return {p[0], p[1], p[2]};
}

// A matrix of numbers may be applied to many vectors at a time.
template <class S, class R>
DYNGS_INLINE Vec3<R> operator*(const Mat3<S>& a, const Vec3<R>& v) {
  const auto& m = a.m;
  return {R(m[0][0]) * v.x + R(m[0][1]) * v.y + R(m[0][2]) * v.z,
          R(m[1][0]) * v.x + R(m[1][1]) * v.y + R(m[1][2]) * v.z,
          R(m[2][0]) * v.x + R(m[2][1]) * v.y + R(m[2][2]) * v.z};
}

// The transpose of `a` times v.
template <class S, class R>
DYNGS_INLINE Vec3<R> transposed_times(const Mat3<S>& a, const Vec3<R>& v) {
  const auto& m = a.m;
  return {R(m[0][0]) * v.x + R(m[1][0]) * v.y + R(m[2][0]) * v.z,
          R(m[0][1]) * v.x + R(m[1][1]) * v.y + R(m[2][1]) * v.z,
          R(m[0][2]) * v.x + R(m[1][2]) * v.y + R(m[2][2]) * v.z};
}

template <class R>
DYNGS_INLINE R norm(const Vec3<R>& v) {
  return sqrt(dot(v, v));
}

// v / |v|; a vector shorter than 1e-12 is divided by that; NaN stays. `inv_norm` is the factor, for the vjp.
template <class R>
DYNGS_INLINE Vec3<R> normalize(const Vec3<R>& v, R& inv_norm) {
  inv_norm = real<R>(1) / max(real<R>(1e-12), norm(v));
  return v * inv_norm;
}

// Gradient by v from that by the unit vector: its part along the unit vector is lost.
template <class R>
DYNGS_INLINE Vec3<R> normalize_vjp(const Vec3<R>& unit, R inv_norm, const Vec3<R>& g) {
  return (g - unit * dot(g, unit)) * inv_norm;
}

}  // namespace dyngs

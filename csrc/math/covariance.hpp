// The 2D covariance of a Gaussian seen through a linear map, and its vjp. Templates over a scalar or a vector of lanes.
//
// With the map A (2x3, here J W), the rotation R and the scales S, C = M M^T + eps I with M = A R S (2x3). Instead of
// the conic C^-1 we carry its upper triangular square root F = [[U, W], [0, V]], C^-1 = F^T F, so that the exponent is
// -(u^2 + v^2) / 2 with u = U dx + W dy, v = V dy: never positive, whatever the rounding. With n = M_row1 / sqrt(C_yy),
//   V = C_yy^(-1/2),  b = <M_row0, n>,  W = -b V U,  U = c^(-1/2),
//   c = det C / C_yy = sum_{k<l} (M_0k n_l - M_0l n_k)^2 + eps (|M_row0|^2 V^2 + 1)      (Cauchy-Binet)
// which holds no difference of large numbers: needles keep their width in float32.
#pragma once

#include "math/quaternion.hpp"

namespace dyngs {

template <class R>
struct Conic {
  R u, w, v;       // F, 1/px
  R compensation;  // sqrt(det C(eps=0) / det C)
  R var_x, var_y;  // diagonal of C, px^2
};

// Gradient of a scalar by the differentiable part of a Conic.
template <class R>
struct ConicGrad {
  R u, w, v, compensation;
};

// Intermediate values that the vjp needs again.
template <class R>
struct CovarianceState {
  Mat3<R> rot;  // R
  R a[2][3];    // A
  R g[2][3];    // A R
  R m[2][3];    // A R S
  R n[3];       // row 1 of M / sqrt(C_yy)
  R b, c, sum_minors, norm0;
};

template <class R>
DYNGS_HD Conic<R> conic_of_covariance(const R (&a)[2][3], const Quat<R>& unit, const Vec3<R>& scale, Scalar<R> eps,
                                      CovarianceState<R>& st) {
  st.rot = rotation_matrix(unit);
  const R s[3] = {scale.x, scale.y, scale.z};
  for (int i = 0; i < 2; ++i)
    for (int k = 0; k < 3; ++k) {
      st.a[i][k] = a[i][k];
      st.g[i][k] = a[i][0] * st.rot.m[0][k] + a[i][1] * st.rot.m[1][k] + a[i][2] * st.rot.m[2][k];
      st.m[i][k] = st.g[i][k] * s[k];
    }
  const auto& m0 = st.m[0];
  const auto& m1 = st.m[1];
  const R one = real<R>(1);
  const R var_y = m1[0] * m1[0] + m1[1] * m1[1] + m1[2] * m1[2] + R(eps);
  const R v = one / sqrt(var_y);
  for (int k = 0; k < 3; ++k) st.n[k] = m1[k] * v;
  st.b = m0[0] * st.n[0] + m0[1] * st.n[1] + m0[2] * st.n[2];
  st.norm0 = m0[0] * m0[0] + m0[1] * m0[1] + m0[2] * m0[2];
  const R d01 = m0[0] * st.n[1] - m0[1] * st.n[0], d02 = m0[0] * st.n[2] - m0[2] * st.n[0];
  const R d12 = m0[1] * st.n[2] - m0[2] * st.n[1];
  st.sum_minors = d01 * d01 + d02 * d02 + d12 * d12;
  st.c = st.sum_minors + R(eps) * (st.norm0 * v * v + one);

  Conic<R> out;
  out.u = one / sqrt(st.c);
  out.v = v;
  out.w = -st.b * v * out.u;
  out.compensation = sqrt(st.sum_minors / st.c);
  out.var_x = st.norm0 + R(eps);
  out.var_y = var_y;
  return out;
}

template <class R>
struct CovarianceGrad {
  R a[2][3];     // by A
  Quat<R> unit;  // by the unit quaternion
  Vec3<R> scale;
};

// Gradient by M (2x3), and by the scales of its columns.
//
// The slope W = -s U, s = <M_row0, M_row1> / C_yy, of a needle hardly depends on its length; but the two terms that the
// two rows of its column contribute to that are large numbers of opposite sign. Their sum is 2 q_k M_1k / C_yy with
// q = M_row0 - s M_row1, and
//   q_k = sum_l n_l (M_0k n_l - M_0l n_k) + eps M_0k / C_yy
// is a sum of small numbers.
template <class R>
DYNGS_HD void conic_vjp(const CovarianceState<R>& st, const Conic<R>& out, const ConicGrad<R>& g, Scalar<R> eps,
                        R (&gm)[2][3], R (&gs)[3]) {
  const auto& m0 = st.m[0];
  const auto& m1 = st.m[1];
  const R zero = real<R>(0), half = real<R>(0.5), one = real<R>(1), two = real<R>(2);
  // c = minors + eps h with h = |M_row0|^2 V^2 + 1; d(minors / c) = eps (h dminors - minors dh) / c^2, without the
  // difference of nearly equal terms that dminors / c - minors dc / c^2 is for large splats. The slope of the
  // compensation sqrt(minors / c) is unbounded at zero area, where we stop it.
  const auto has_area = st.sum_minors > real<R>(1e-12) * st.c;
  const R by_area = select(has_area, half * g.compensation / max(out.compensation, real<R>(1e-6)), zero);
  const R h = st.norm0 * out.v * out.v + one, share = R(eps) / st.c;
  const R slope = st.b * out.v, g_slope = -out.v * out.v * out.u * g.w;  // the latter by s C_yy
  const R g_u = g.u - slope * g.w;
  R g_v = g.v;
  const R g_c = -half * out.u * out.u * out.u * g_u;
  const R g_minors = g_c + by_area * share * h / st.c;
  const R g_h = R(eps) * g_c - by_area * share * (st.sum_minors / st.c);
  const R g_norm0 = out.v * out.v * g_h;
  g_v += two * st.norm0 * out.v * g_h;
  R g_n[3], q[3];
  for (int k = 0; k < 3; ++k) {
    gm[0][k] = two * m0[k] * g_norm0;
    g_n[k] = zero;
    q[k] = R(eps) * out.v * out.v * m0[k];
  }
  for (int k = 0; k < 3; ++k)
    for (int l = k + 1; l < 3; ++l) {
      const R minor = m0[k] * st.n[l] - m0[l] * st.n[k], d = two * g_minors * minor;
      gm[0][k] += d * st.n[l];
      gm[0][l] -= d * st.n[k];
      g_n[l] += d * m0[k];
      g_n[k] -= d * m0[l];
      q[k] += st.n[l] * minor;
      q[l] -= st.n[k] * minor;
    }
  for (int k = 0; k < 3; ++k) g_v += g_n[k] * m1[k];
  const R g_var_y = -half * out.v * out.v * out.v * g_v;
  for (int k = 0; k < 3; ++k) {
    gm[1][k] = g_n[k] * out.v + two * m1[k] * g_var_y;
    gs[k] = gm[0][k] * st.g[0][k] + gm[1][k] * st.g[1][k] + two * g_slope * q[k] * st.g[1][k];
    gm[0][k] += g_slope * m1[k];
    gm[1][k] += g_slope * (q[k] - slope * m1[k]);
  }
}

template <class R>
DYNGS_HD CovarianceGrad<R> covariance_vjp(const Quat<R>& unit, const Vec3<R>& scale, Scalar<R> eps,
                                          const CovarianceState<R>& st, const Conic<R>& out, const ConicGrad<R>& g) {
  R gm[2][3], gs[3];
  conic_vjp(st, out, g, eps, gm, gs);
  const R s[3] = {scale.x, scale.y, scale.z};
  R gg[2][3];
  Mat3<R> g_rot;
  for (int k = 0; k < 3; ++k) {
    gg[0][k] = gm[0][k] * s[k];
    gg[1][k] = gm[1][k] * s[k];
  }
  for (int j = 0; j < 3; ++j)
    for (int k = 0; k < 3; ++k) g_rot.m[j][k] = st.a[0][j] * gg[0][k] + st.a[1][j] * gg[1][k];
  CovarianceGrad<R> grad;
  for (int i = 0; i < 2; ++i)
    for (int j = 0; j < 3; ++j)
      grad.a[i][j] = gg[i][0] * st.rot.m[j][0] + gg[i][1] * st.rot.m[j][1] + gg[i][2] * st.rot.m[j][2];
  grad.unit = rotation_matrix_vjp(unit, g_rot);
  grad.scale = {gs[0], gs[1], gs[2]};
  return grad;
}

}  // namespace dyngs

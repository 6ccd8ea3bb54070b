// Projection of one 3D Gaussian to the image plane (EWA splatting, Zwicker et al. 2001; 3DGS, Kerbl et al. 2023), and
// its vjp. Templates over a scalar or a packet.
//
// The 2D covariance is C = M M^T + eps I with M = J W R S (2x3). Instead of the conic C^-1 we carry its upper
// triangular square root F = [[U, W], [0, V]], C^-1 = F^T F, so that the exponent is -(u^2 + v^2) / 2 with
// u = U dx + W dy, v = V dy: never positive, whatever the rounding. With n = M_row1 / sqrt(C_yy),
//   V = C_yy^(-1/2),  b = <M_row0, n>,  W = -b V U,  U = c^(-1/2),
//   c = det C / C_yy = sum_{k<l} (M_0k n_l - M_0l n_k)^2 + eps (|M_row0|^2 V^2 + 1)      (Cauchy-Binet)
// which holds no difference of large numbers: needles keep their width in float32.
#pragma once

#include "math/packet.hpp"

namespace dyngs {

template <class R>
struct Quat { R w, x, y, z; };
template <class R>
struct Vec3 { R x, y, z; };
template <class R>
struct Mat3 { R m[3][3]; };

// A pinhole camera: cam_from_world rotation and translation, intrinsics, image size in px.
template <class S>
struct Pinhole {
  S rotation[3][3];
  S translation[3];
  S fx, fy, cx, cy;
  S width, height;
};

// Unit quaternion along q. Scaled by the largest entry first, so neither 1e30 nor denormals over- or underflow.
// A zero (or NaN) quaternion gives the identity. `inv_norm` is 1/|q|, at most 1e12, for the vjp (0 for the identity).
template <class R>
Quat<R> normalize(const Quat<R>& q, R& inv_norm) {
  using S = typename ScalarOf<R>::type;
  const R largest = max_of(max_of(abs_of(q.w), abs_of(q.x)), max_of(abs_of(q.y), abs_of(q.z)));
  const auto valid = largest > R(S(0));
  const R scale = select(valid, largest, R(S(1)));
  const R w = select(valid, q.w / scale, R(S(1))), x = select(valid, q.x / scale, R(S(0)));
  const R y = select(valid, q.y / scale, R(S(0))), z = select(valid, q.z / scale, R(S(0)));
  const R inv = R(S(1)) / sqrt_of(w * w + x * x + y * y + z * z);
  inv_norm = select(valid, inv / max_of(scale, R(S(1e-12))), R(S(0)));
  return {w * inv, x * inv, y * inv, z * inv};
}

// Tangent projection: v_q = (v_n - n <n, v_n>) / |q|.
template <class R>
Quat<R> normalize_vjp(const Quat<R>& n, R inv_norm, const Quat<R>& g) {
  const R dot = n.w * g.w + n.x * g.x + n.y * g.y + n.z * g.z;
  return {(g.w - n.w * dot) * inv_norm, (g.x - n.x * dot) * inv_norm, (g.y - n.y * dot) * inv_norm,
          (g.z - n.z * dot) * inv_norm};
}

template <class R>
Mat3<R> rotation_matrix(const Quat<R>& q) {
  using S = typename ScalarOf<R>::type;
  const R one(S(1)), two(S(2));
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

template <class R>
Quat<R> rotation_matrix_vjp(const Quat<R>& q, const Mat3<R>& g) {
  using S = typename ScalarOf<R>::type;
  const R two(S(2));
  const auto& m = g.m;
  return {two * (q.x * (m[2][1] - m[1][2]) + q.y * (m[0][2] - m[2][0]) + q.z * (m[1][0] - m[0][1])),
          two * (q.w * (m[2][1] - m[1][2]) + q.y * (m[0][1] + m[1][0]) + q.z * (m[0][2] + m[2][0]) -
                 two * q.x * (m[1][1] + m[2][2])),
          two * (q.w * (m[0][2] - m[2][0]) + q.x * (m[0][1] + m[1][0]) + q.z * (m[1][2] + m[2][1]) -
                 two * q.y * (m[0][0] + m[2][2])),
          two * (q.w * (m[1][0] - m[0][1]) + q.x * (m[0][2] + m[2][0]) + q.y * (m[1][2] + m[2][1]) -
                 two * q.z * (m[0][0] + m[1][1]))};
}

// What the image plane sees of one Gaussian.
template <class R>
struct Splat {
  R x, y;           // 2D mean, px
  R depth;          // view-space z
  R u, w, v;        // factor F of the conic, 1/px
  R compensation;   // sqrt(det C(eps=0) / det C)
  R var_x, var_y;   // diagonal of C, px^2
};

// Gradient of a scalar with respect to the differentiable part of a Splat.
template <class R>
struct SplatGrad { R x, y, depth, u, w, v, compensation; };

// Intermediate values that the vjp needs again.
template <class R>
struct ProjectionState {
  Vec3<R> cam;      // centre in the camera
  R rz, tx, ty;     // 1/z and the clamped x/z, y/z
  decltype(std::declval<R>() < std::declval<R>()) free_x, free_y;  // clamp inactive
  Mat3<R> rot;      // R
  R a[2][3];        // J W
  R g[2][3];        // J W R
  R m[2][3];        // J W R S
  R n[3];           // row 1 of m / sqrt(C_yy)
  R b, c, sum_minors, norm0;
};

template <class R, class S>
Vec3<R> to_camera(const Pinhole<S>& cam, const Vec3<R>& p) {
  const auto& r = cam.rotation;
  return {R(r[0][0]) * p.x + R(r[0][1]) * p.y + R(r[0][2]) * p.z + R(cam.translation[0]),
          R(r[1][0]) * p.x + R(r[1][1]) * p.y + R(r[1][2]) * p.z + R(cam.translation[1]),
          R(r[2][0]) * p.x + R(r[2][1]) * p.y + R(r[2][2]) * p.z + R(cam.translation[2])};
}


template <class R, class S>
Splat<R> project(const Pinhole<S>& cam, const Vec3<R>& p_cam, const Quat<R>& unit, const Vec3<R>& scale, S eps,
                 ProjectionState<R>& st) {
  st.cam = p_cam;
  // In J, x/z is clamped to 30% of the half field of view beyond each image edge (gsplat's bounds).
  st.rz = R(S(1)) / p_cam.z;
  const R x = p_cam.x * st.rz, y = p_cam.y * st.rz;
  const S margin_x = S(0.15) * cam.width / cam.fx, margin_y = S(0.15) * cam.height / cam.fy;
  const R lo_x(-cam.cx / cam.fx - margin_x), hi_x((cam.width - cam.cx) / cam.fx + margin_x);
  const R lo_y(-cam.cy / cam.fy - margin_y), hi_y((cam.height - cam.cy) / cam.fy + margin_y);
  st.free_x = (x >= lo_x) & (x <= hi_x);
  st.free_y = (y >= lo_y) & (y <= hi_y);
  st.tx = min_of(max_of(x, lo_x), hi_x);
  st.ty = min_of(max_of(y, lo_y), hi_y);

  st.rot = rotation_matrix(unit);
  const R j00 = R(cam.fx) * st.rz, j02 = -j00 * st.tx, j11 = R(cam.fy) * st.rz, j12 = -j11 * st.ty;
  const R s[3] = {scale.x, scale.y, scale.z};
  for (int j = 0; j < 3; ++j) {
    st.a[0][j] = j00 * R(cam.rotation[0][j]) + j02 * R(cam.rotation[2][j]);
    st.a[1][j] = j11 * R(cam.rotation[1][j]) + j12 * R(cam.rotation[2][j]);
  }
  for (int i = 0; i < 2; ++i)
    for (int k = 0; k < 3; ++k) {
      st.g[i][k] = st.a[i][0] * st.rot.m[0][k] + st.a[i][1] * st.rot.m[1][k] + st.a[i][2] * st.rot.m[2][k];
      st.m[i][k] = st.g[i][k] * s[k];
    }
  const auto& m0 = st.m[0];
  const auto& m1 = st.m[1];
  const R var_y = m1[0] * m1[0] + m1[1] * m1[1] + m1[2] * m1[2] + R(eps);
  const R v = R(S(1)) / sqrt_of(var_y);
  for (int k = 0; k < 3; ++k) st.n[k] = m1[k] * v;
  st.b = m0[0] * st.n[0] + m0[1] * st.n[1] + m0[2] * st.n[2];
  st.norm0 = m0[0] * m0[0] + m0[1] * m0[1] + m0[2] * m0[2];
  const R d01 = m0[0] * st.n[1] - m0[1] * st.n[0], d02 = m0[0] * st.n[2] - m0[2] * st.n[0];
  const R d12 = m0[1] * st.n[2] - m0[2] * st.n[1];
  st.sum_minors = d01 * d01 + d02 * d02 + d12 * d12;
  st.c = st.sum_minors + R(eps) * (st.norm0 * v * v + R(S(1)));

  Splat<R> out;
  out.x = R(cam.fx) * x + R(cam.cx);
  out.y = R(cam.fy) * y + R(cam.cy);
  out.depth = p_cam.z;
  out.u = R(S(1)) / sqrt_of(st.c);
  out.v = v;
  out.w = -st.b * v * out.u;
  out.compensation = sqrt_of(st.sum_minors / st.c);
  out.var_x = st.norm0 + R(eps);
  out.var_y = var_y;
  return out;
}

template <class R>
struct ProjectionGrad {
  Vec3<R> cam;     // with respect to the centre in the camera
  Quat<R> unit;    // with respect to the unit quaternion
  Vec3<R> scale;
  R view[3][3];    // with respect to the camera's rotation, through J W only
};

// Gradient with respect to M (2x3) of the splat's shape, and with respect to the scales of its columns.
//
// The slope W = -s U, s = <M_row0, M_row1> / C_yy, of a needle hardly depends on its length; but what the two rows of its
// column say about that are large numbers of opposite sign. Their sum is 2 q_k M_1k / C_yy with q = M_row0 - s M_row1, and
//   q_k = sum_l n_l (M_0k n_l - M_0l n_k) + eps M_0k / C_yy
// is a sum of small numbers.
template <class R>
void shape_vjp(const ProjectionState<R>& st, const Splat<R>& out, const SplatGrad<R>& g, typename ScalarOf<R>::type eps,
               R (&gm)[2][3], R (&gs)[3]) {
  using S = typename ScalarOf<R>::type;
  const auto& m0 = st.m[0];
  const auto& m1 = st.m[1];
  const R two(S(2)), half(S(0.5));
  // c = minors + eps h with h = |M_row0|^2 V^2 + 1; d(minors / c) = eps (h dminors - minors dh) / c^2, without the
  // difference of nearly equal terms that dminors / c - minors dc / c^2 is for large splats. The slope of the
  // compensation sqrt(minors / c) is unbounded at zero area, where we stop it.
  const auto has_area = st.sum_minors > R(S(1e-12)) * st.c;
  const R by_area = select(has_area, half * g.compensation / max_of(out.compensation, R(S(1e-6))), R(S(0)));
  const R h = st.norm0 * out.v * out.v + R(S(1)), share = R(eps) / st.c;
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
    g_n[k] = R(S(0));
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

template <class R, class S>
ProjectionGrad<R> project_vjp(const Pinhole<S>& cam, const Quat<R>& unit, const Vec3<R>& scale, S eps,
                              const ProjectionState<R>& st, const Splat<R>& out, const SplatGrad<R>& g) {
  R gm[2][3], gs[3];
  shape_vjp(st, out, g, eps, gm, gs);
  const R s[3] = {scale.x, scale.y, scale.z};
  R gg[2][3], ga[2][3];
  Mat3<R> g_rot;
  for (int k = 0; k < 3; ++k) {
    gg[0][k] = gm[0][k] * s[k];
    gg[1][k] = gm[1][k] * s[k];
  }
  for (int j = 0; j < 3; ++j)
    for (int k = 0; k < 3; ++k) g_rot.m[j][k] = st.a[0][j] * gg[0][k] + st.a[1][j] * gg[1][k];
  for (int i = 0; i < 2; ++i)
    for (int j = 0; j < 3; ++j)
      ga[i][j] = gg[i][0] * st.rot.m[j][0] + gg[i][1] * st.rot.m[j][1] + gg[i][2] * st.rot.m[j][2];

  const R j00 = R(cam.fx) * st.rz, j02 = -j00 * st.tx, j11 = R(cam.fy) * st.rz, j12 = -j11 * st.ty;
  R g_j00(S(0)), g_j02(S(0)), g_j11(S(0)), g_j12(S(0));
  ProjectionGrad<R> grad;
  for (int j = 0; j < 3; ++j) {
    g_j00 += ga[0][j] * R(cam.rotation[0][j]);
    g_j02 += ga[0][j] * R(cam.rotation[2][j]);
    g_j11 += ga[1][j] * R(cam.rotation[1][j]);
    g_j12 += ga[1][j] * R(cam.rotation[2][j]);
    grad.view[0][j] = j00 * ga[0][j];
    grad.view[1][j] = j11 * ga[1][j];
    grad.view[2][j] = j02 * ga[0][j] + j12 * ga[1][j];
  }
  // J = [fx/z, 0, -fx tx/z; 0, fy/z, -fy ty/z] with tx = clamp(x/z); mean = (fx x/z + cx, fy y/z + cy)
  const R fx(cam.fx), fy(cam.fy), zero(S(0));
  R g_rz = fx * (g_j00 - st.tx * g_j02) + fy * (g_j11 - st.ty * g_j12);
  R g_tan_x = fx * g.x + select(st.free_x, -j00 * g_j02, zero);
  R g_tan_y = fy * g.y + select(st.free_y, -j11 * g_j12, zero);
  g_rz += st.cam.x * g_tan_x + st.cam.y * g_tan_y;
  grad.cam = {st.rz * g_tan_x, st.rz * g_tan_y, g.depth - st.rz * st.rz * g_rz};
  grad.unit = rotation_matrix_vjp(unit, g_rot);
  grad.scale = {gs[0], gs[1], gs[2]};
  return grad;
}

}  // namespace dyngs

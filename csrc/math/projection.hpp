// Projection of one 3D Gaussian to the image plane (EWA splatting, Zwicker et al. 2001; 3DGS, Kerbl et al. 2023), its
// vjp, and how far it can be seen. Templates over a scalar or a vector of lanes.
#pragma once

#include "math/covariance.hpp"

namespace dyngs {

// A pinhole camera: cam_from_world rotation and translation, intrinsics, image size in px.
template <class S>
struct Pinhole {
  Mat3<S> rotation;
  Vec3<S> translation;
  S fx, fy, cx, cy;
  S width, height;
};

// `viewmat` (4, 4) cam_from_world, `intrinsics` (3, 3) px.
template <class S>
DYNGS_HD Pinhole<S> pinhole(const S* viewmat, const S* intrinsics, int width, int height) {
  Pinhole<S> cam;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) cam.rotation.m[i][j] = viewmat[4 * i + j];
  }
  cam.translation = {viewmat[3], viewmat[7], viewmat[11]};
  cam.fx = intrinsics[0], cam.fy = intrinsics[4], cam.cx = intrinsics[2], cam.cy = intrinsics[5];
  cam.width = static_cast<S>(width), cam.height = static_cast<S>(height);
  return cam;
}

// One Gaussian in the image plane.
template <class R>
struct Splat {
  R x, y;          // 2D mean, px
  R depth;         // view-space z
  Conic<R> conic;  // its shape
};

// Gradient of a scalar by the differentiable part of a Splat.
template <class R>
struct SplatGrad {
  R x, y, depth;
  ConicGrad<R> conic;
};

// Intermediate values that the vjp needs again.
template <class R>
struct ProjectionState {
  Vec3<R> cam;               // centre in the camera
  R rz, tx, ty;              // 1/z and the clamped x/z, y/z
  MaskOf<R> free_x, free_y;  // clamp inactive
  CovarianceState<R> shape;
};

template <class R, class S>
DYNGS_HD Vec3<R> to_camera(const Pinhole<S>& cam, const Vec3<R>& p) {
  return cam.rotation * p + Vec3<R>{R(cam.translation.x), R(cam.translation.y), R(cam.translation.z)};
}

template <class R, class S>
DYNGS_HD Splat<R> project(const Pinhole<S>& cam, const Vec3<R>& p_cam, const Quat<R>& unit, const Vec3<R>& scale, S eps,
                          ProjectionState<R>& st) {
  st.cam = p_cam;
  // In J, x/z is clamped to 30% of the half field of view beyond each image edge (gsplat's bounds).
  st.rz = real<R>(1) / p_cam.z;
  const R x = p_cam.x * st.rz, y = p_cam.y * st.rz;
  const S margin_x = S(0.15) * cam.width / cam.fx, margin_y = S(0.15) * cam.height / cam.fy;
  const R lo_x(-cam.cx / cam.fx - margin_x), hi_x((cam.width - cam.cx) / cam.fx + margin_x);
  const R lo_y(-cam.cy / cam.fy - margin_y), hi_y((cam.height - cam.cy) / cam.fy + margin_y);
  st.free_x = (x >= lo_x) & (x <= hi_x);
  st.free_y = (y >= lo_y) & (y <= hi_y);
  st.tx = clamp(x, lo_x, hi_x);
  st.ty = clamp(y, lo_y, hi_y);

  const R j00 = R(cam.fx) * st.rz, j02 = -j00 * st.tx, j11 = R(cam.fy) * st.rz, j12 = -j11 * st.ty;
  const auto& w = cam.rotation.m;
  R a[2][3];
  for (int j = 0; j < 3; ++j) {
    a[0][j] = j00 * R(w[0][j]) + j02 * R(w[2][j]);
    a[1][j] = j11 * R(w[1][j]) + j12 * R(w[2][j]);
  }
  Splat<R> out;
  out.conic = conic_of_covariance(a, unit, scale, eps, st.shape);
  out.x = R(cam.fx) * x + R(cam.cx);
  out.y = R(cam.fy) * y + R(cam.cy);
  out.depth = p_cam.z;
  return out;
}

template <class R>
struct ProjectionGrad {
  Vec3<R> cam;   // by the centre in the camera
  Quat<R> unit;  // by the unit quaternion
  Vec3<R> scale;
  R view[3][3];          // by the camera's rotation, through J W only
  R j00, j02, j11, j12;  // by the entries of J
};

template <class R, class S>
DYNGS_HD ProjectionGrad<R> project_vjp(const Pinhole<S>& cam, const Quat<R>& unit, const Vec3<R>& scale, S eps,
                                       const ProjectionState<R>& st, const Splat<R>& out, const SplatGrad<R>& g) {
  const CovarianceGrad<R> shape = covariance_vjp(unit, scale, eps, st.shape, out.conic, g.conic);
  const auto& ga = shape.a;
  const R j00 = R(cam.fx) * st.rz, j02 = -j00 * st.tx, j11 = R(cam.fy) * st.rz, j12 = -j11 * st.ty;
  const auto& w = cam.rotation.m;
  const R zero = real<R>(0);
  R g_j00 = zero, g_j02 = zero, g_j11 = zero, g_j12 = zero;
  ProjectionGrad<R> grad;
  for (int j = 0; j < 3; ++j) {
    g_j00 += ga[0][j] * R(w[0][j]);
    g_j02 += ga[0][j] * R(w[2][j]);
    g_j11 += ga[1][j] * R(w[1][j]);
    g_j12 += ga[1][j] * R(w[2][j]);
    grad.view[0][j] = j00 * ga[0][j];
    grad.view[1][j] = j11 * ga[1][j];
    grad.view[2][j] = j02 * ga[0][j] + j12 * ga[1][j];
  }
  // J = [fx/z, 0, -fx tx/z; 0, fy/z, -fy ty/z] with tx = clamp(x/z); mean = (fx x/z + cx, fy y/z + cy)
  const R fx(cam.fx), fy(cam.fy);
  R g_rz = fx * (g_j00 - st.tx * g_j02) + fy * (g_j11 - st.ty * g_j12);
  const R g_tan_x = fx * g.x + select(st.free_x, -j00 * g_j02, zero);
  const R g_tan_y = fy * g.y + select(st.free_y, -j11 * g_j12, zero);
  g_rz += st.cam.x * g_tan_x + st.cam.y * g_tan_y;
  grad.cam = {st.rz * g_tan_x, st.rz * g_tan_y, g.depth - st.rz * st.rz * g_rz};
  grad.unit = shape.unit;
  grad.scale = shape.scale;
  grad.j00 = g_j00, grad.j02 = g_j02, grad.j11 = g_j11, grad.j12 = g_j12;
  return grad;
}

// Gradient by the intrinsics of the camera.
template <class R>
struct IntrinsicsGrad {
  R fx, fy, cx, cy;
};

// Continues project_vjp, whose result is `d`. Where the clamp is active, fx tx = const - cx: fx cancels in J.
template <class R>
DYNGS_HD IntrinsicsGrad<R> intrinsics_vjp(const ProjectionState<R>& st, const SplatGrad<R>& g,
                                          const ProjectionGrad<R>& d) {
  const R zero = real<R>(0), x = st.cam.x * st.rz, y = st.cam.y * st.rz;
  return {x * g.x + st.rz * (d.j00 - select(st.free_x, st.tx * d.j02, zero)),
          y * g.y + st.rz * (d.j11 - select(st.free_y, st.ty * d.j12, zero)),
          g.x + select(st.free_x, zero, st.rz * d.j02), g.y + select(st.free_y, zero, st.rz * d.j12)};
}

// The rectangle in which a splat can be seen.
template <class R>
struct Extent {
  R x, y;             // half extents, px; not to be used where not visible
  MaskOf<R> visible;  // some of it may lie in the image
};

// Half extents where alpha can reach alpha_min: Mahalanobis^2 <= t = 2 ln(opacity / alpha_min) (SnugBox, Hanson et al.
// 2025). Splats no larger than radius_clip either way are not visible, nor those with anything infinite or NaN.
template <class R, class S>
DYNGS_HD Extent<R> visible_extent(const Splat<R>& splat, R opacity, Vec2<S> image_size, S alpha_min, S radius_clip) {
  const R zero = real<R>(0), limit = real<R>(1e9);  // keeps radii of 32 bits defined
  const R t = real<R>(2) * log(opacity / R(alpha_min));
  const Conic<R>& c = splat.conic;
  Extent<R> e;
  e.x = min(ceil(sqrt(t * c.var_x)), limit);
  e.y = min(ceil(sqrt(t * c.var_y)), limit);
  const R clip(radius_clip), most(kLargest<S>);
  // every comparison is false for NaN
  e.visible = (t > zero) & ((e.x > clip) | (e.y > clip)) & (e.x > zero) & (e.y > zero) & (splat.x + e.x > zero) &
              (splat.x - e.x < R(image_size.x)) & (splat.y + e.y > zero) & (splat.y - e.y < R(image_size.y)) &
              (c.u > zero) & (c.u <= most) & (c.v > zero) & (c.v <= most) & (abs(c.w) <= most) &
              (c.compensation <= most);
  return e;
}

}  // namespace dyngs

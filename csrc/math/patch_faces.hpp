// The flat faces that a Bezier patch is drawn as, in the camera: how many, which pixels may show each, and where on the patch a
// pixel's ray meets one.
#pragma once

#include "math/bezier.hpp"
#include "math/projection.hpp"

namespace dyngs {

inline constexpr double kFlat = 0.1;  // px that faces may be off their patch, where there may be enough of them
inline constexpr double kEndless = kLargest<double>;

// Pixels from x0 to before x1, y0 to before y1.
struct PixelBox {
  int x0, y0, x1, y1;

  DYNGS_HD bool empty() const { return x0 >= x1 || y0 >= y1; }
};

DYNGS_HD inline int first_pixel(double x, double size) {
  return static_cast<int>(clamp(std::ceil(x - 0.5), 0.0, size));
}
DYNGS_HD inline int end_pixel(double x, double size) {
  return static_cast<int>(clamp(std::floor(x - 0.5) + 1.0, 0.0, size));
}

// The pixels whose centres may lie within the part of a triangle that is not nearer than `near`.
DYNGS_HD inline PixelBox pixels_of(const Pinhole<double>& cam, double near, const Vec3<double> (&corners)[3]) {
  double x0 = kEndless, y0 = kEndless, x1 = -kEndless, y1 = -kEndless;
  const auto add = [&](const Vec3<double>& p) {
    const double x = cam.fx * p.x / p.z + cam.cx, y = cam.fy * p.y / p.z + cam.cy;
    x0 = min(x0, x), x1 = max(x1, x), y0 = min(y0, y), y1 = max(y1, y);
  };
  for (int i = 0; i < 3; ++i) {
    const Vec3<double>&a = corners[i], &b = corners[(i + 1) % 3];
    if (a.z >= near) add(a);
    if ((a.z >= near) != (b.z >= near)) {
      Vec3<double> cut = a + (b - a) * ((near - a.z) / (b.z - a.z));
      cut.z = near;
      add(cut);
    }
  }
  return {first_pixel(x0, cam.width), first_pixel(y0, cam.height), end_pixel(x1, cam.width), end_pixel(y1, cam.height)};
}

// The number of segments per edge, at most `most`, that keeps flat faces within kFlat px of a patch with these camera-space
// control points: a parabola over n segments is farthest from its chords by a quarter of its second difference over n^2.
DYNGS_HD inline int segments_for(const Pinhole<double>& cam, double near, int most,
                                 const Vec3<double> (&points)[kPatchPoints]) {
  const int edges[3][3] = {{0, 1, 3}, {0, 2, 5}, {3, 4, 5}};
  double bend = 0, nearest = kEndless;
  for (const auto& edge : edges) {
    const Vec3<double> d = points[edge[0]] + points[edge[2]] - points[edge[1]] * 2.0;
    bend = max(bend, dot(d, d));
  }
  for (const auto& p : points) nearest = min(nearest, p.z);
  const double across = max(cam.fx, cam.fy) * sqrt(bend) / (4 * max(nearest, near));
  return static_cast<int>(clamp(std::ceil(sqrt(across / kFlat)), 1.0, static_cast<double>(most)));
}

template <class S, class P>
DYNGS_HD bool is_finite_patch(const P& control) {
  for (int i = 0; i < 3 * kPatchPoints; ++i) {
    if (!(S(control[i]) - S(control[i]) == S(0))) return false;
  }
  return true;
}

// A face of a lattice: its corners' places in the list of points, and the point (i, j) that it is described by.
struct PatchFace {
  int corners[3];
  int i, j;
  bool upper;  // beyond that point's diagonal
};

// f(face) of all of a lattice of n segments, in their order.
template <class F>
DYNGS_HD void for_each_face(int n, F&& f) {
  for (int i = 0; i < n; ++i) {
    for (int j = 0; i + j < n; ++j) {
      const int right = lattice_index(n, i + 1, j), up = lattice_index(n, i, j + 1);
      f(PatchFace{{lattice_index(n, i, j), right, up}, i, j, false});
      if (i + j + 2 <= n) f(PatchFace{{lattice_index(n, i + 1, j + 1), up, right}, i, j, true});
    }
  }
}

// z where the ray of a pixel meets a face, 0 for nowhere, and the place on the patch there.
DYNGS_HD inline double hit_face(const Pinhole<double>& cam, const RayTriangle& triangle, const PatchFace& face, int n,
                                int x, int y, double& u, double& v) {
  double bary[3];
  const double z = hit(triangle, (x + 0.5 - cam.cx) / cam.fx, (y + 0.5 - cam.cy) / cam.fy, bary);
  u = (face.upper ? face.i + 1 - bary[1] : face.i + bary[1]) / n;
  v = (face.upper ? face.j + 1 - bary[2] : face.j + bary[2]) / n;
  return z;
}

}  // namespace dyngs

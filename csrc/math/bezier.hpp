// Quadratic triangular Bezier patches (Farin 1986), the lattice that cuts one into n^2 flat faces, and values that are
// linear on such faces. A place on a patch is (u, v), w = 1 - u - v. Control points (i, j, k), i + j + k = 2, belong to
// u^i v^j w^k, in the order 200, 110, 101, 020, 011, 002; points (i, j, k) / n of a lattice are in the same order.
#pragma once

#include "math/vec.hpp"

namespace dyngs {

inline constexpr int kPatchPoints = 6;

// Which values of a patch are looked up: of the quadratic, its derivatives by u and by v, or those of a lattice.
enum class PatchBasis { kQuadratic = 0, kAlongU = -1, kAlongV = -2, kLattice = 1 };

// Weights of up to six values, and which values these are.
template <class S>
struct PatchWeights {
  int count;
  int index[kPatchPoints];
  S weight[kPatchPoints];
};

template <class S>
DYNGS_HD PatchWeights<S> all_points(S a, S b, S c, S d, S e, S f) {
  return {kPatchPoints, {0, 1, 2, 3, 4, 5}, {a, b, c, d, e, f}};
}

template <class S>
DYNGS_HD PatchWeights<S> quadratic_weights(S u, S v) {
  const S w = S(1) - u - v;
  return all_points(u * u, S(2) * u * v, S(2) * u * w, v * v, S(2) * v * w, w * w);
}

// Derivatives along u and v at the other held constant.
template <class S>
DYNGS_HD PatchWeights<S> quadratic_weights_along_u(S u, S v) {
  const S w = S(1) - u - v;
  return all_points(S(2) * u, S(2) * v, S(2) * (w - u), S(0), S(-2) * v, S(-2) * w);
}
template <class S>
DYNGS_HD PatchWeights<S> quadratic_weights_along_v(S u, S v) {
  const S w = S(1) - u - v;
  return all_points(S(0), S(2) * u, S(-2) * u, S(2) * v, S(2) * (w - v), S(-2) * w);
}

DYNGS_HD inline int lattice_size(int n) { return (n + 1) * (n + 2) / 2; }
DYNGS_HD inline int lattice_index(int n, int i, int j) { return (n - i) * (n - i + 1) / 2 + n - i - j; }

// Of the three corners of the face of a lattice of n segments that (u, v) lies on; places outside count as on the rim.
template <class S>
DYNGS_HD PatchWeights<S> lattice_weights(int n, S u, S v) {
  const S x = clamp(u, S(0), S(1)) * S(n), y = clamp(v, S(0), S(1)) * S(n);
  int i = static_cast<int>(x), j = static_cast<int>(y);
  i = i < n - 1 ? i : n - 1;
  j = j < n - 1 - i ? j : n - 1 - i;
  const S fu = clamp(x - S(i), S(0), S(1)), fv = clamp(y - S(j), S(0), S(1));
  PatchWeights<S> found{3, {}, {}};
  found.index[1] = lattice_index(n, i + 1, j), found.index[2] = lattice_index(n, i, j + 1);
  if (fu + fv > S(1) && i + j + 2 <= n) {
    found.index[0] = lattice_index(n, i + 1, j + 1);
    found.weight[0] = fu + fv - S(1), found.weight[1] = S(1) - fv, found.weight[2] = S(1) - fu;
  } else {
    const S scale = fu + fv > S(1) ? S(1) / (fu + fv) : S(1);
    found.index[0] = lattice_index(n, i, j);
    found.weight[1] = fu * scale, found.weight[2] = fv * scale;
    found.weight[0] = max(S(1) - found.weight[1] - found.weight[2], S(0));
  }
  return found;
}

template <class S>
DYNGS_HD PatchWeights<S> patch_weights(PatchBasis basis, int segments, S u, S v) {
  switch (basis) {
    case PatchBasis::kQuadratic: return quadratic_weights(u, v);
    case PatchBasis::kAlongU: return quadratic_weights_along_u(u, v);
    case PatchBasis::kAlongV: return quadratic_weights_along_v(u, v);
    default: return lattice_weights(segments, u, v);
  }
}

// A flat triangle in the camera and where rays through the camera meet it (Olano and Greer 1997): no clipping is needed,
// and barycentric coordinates are perspective-correct.
struct RayTriangle {
  Vec3<double> edges[3];  // of the corner of the same number: its coordinate grows with <edge, ray>
  double volume;          // six times that of the tetrahedron with the camera

  DYNGS_INLINE bool is_drawn() const { return volume > 0; }  // not edge-on, not NaN
};

DYNGS_HD inline Vec3<double> cross(const Vec3<double>& a, const Vec3<double>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// Both sides are alike: the signs are such that the volume is positive.
DYNGS_HD inline RayTriangle ray_triangle(const Vec3<double>& a, const Vec3<double>& b, const Vec3<double>& c) {
  RayTriangle t{{cross(b, c), cross(c, a), cross(a, b)}, 0};
  t.volume = dot(a, t.edges[0]);
  if (t.volume < 0) {
    for (auto& edge : t.edges) edge = edge * -1.0;
    t.volume = -t.volume;
  }
  return t;
}

// z where the ray (x, y, 1) meets it, and the barycentric coordinates there; z = 0: nowhere in front of the camera.
DYNGS_HD inline double hit(const RayTriangle& t, double x, double y, double (&bary)[3]) {
  double sum = 0;
  for (int i = 0; i < 3; ++i) {
    bary[i] = t.edges[i].x * x + t.edges[i].y * y + t.edges[i].z;
    if (!(bary[i] >= 0)) return 0;
    sum += bary[i];
  }
  if (!(sum > 0)) return 0;
  for (double& part : bary) part /= sum;
  return t.volume / sum;
}

}  // namespace dyngs

// The outline of a Bezier patch between two pixels, and the coverage of a pixel by its neighbour: the boundary-aware
// weights of BG-Triangle (Wu et al. 2025), linear, in the distance along a row or column. A patch counts 1 inside, a half at
// its outline, 0 outside.
#pragma once

#include "math/bezier.hpp"
#include "math/projection.hpp"

namespace dyngs {

// Steps to the next pixel: right, left, down, up.
inline constexpr int kDirections = 4;
template <class S>
DYNGS_HD Vec2<S> pixel_step(int direction) {
  const S sign = direction % 2 == 0 ? S(1) : S(-1);
  return direction < 2 ? Vec2<S>{sign, S(0)} : Vec2<S>{S(0), sign};
}

// Least sine of the angle between an outline and a step: an upright one is looked for along rows, a level one along columns, so
// that what each covers is counted once.
inline constexpr double kLeastSine = 0.7071067811865476;
// Steps beyond the next pixel that still count as at it, since patches are drawn as flat faces.
inline constexpr double kEndSlack = 0.25;

// The end of a patch within one step from a point on it.
template <class S>
struct PatchEnd {
  bool is_found;
  S t;            // steps
  S u, v;         // the place on its edge
  Vec2<S> slope;  // change of t by that of the place's mean, px
};

// A place in the image and its derivatives by u and by v, px.
template <class S>
struct PatchJet {
  Vec2<S> at, by_u, by_v;
};

template <class S, class P>
DYNGS_HD Vec3<S> patch_sum(const P& control, const PatchWeights<S>& at) {
  Vec3<S> sum{S(0), S(0), S(0)};
  for (int k = 0; k < kPatchPoints; ++k)
    sum = sum + Vec3<S>{S(control[3 * k]), S(control[3 * k + 1]), S(control[3 * k + 2])} * at.weight[k];
  return sum;
}

template <class S, class P>
DYNGS_HD PatchJet<S> patch_jet(const Pinhole<S>& cam, const P& control, S u, S v) {
  const Vec3<S> p = to_camera(cam, patch_sum<S>(control, quadratic_weights(u, v)));
  const S rz = S(1) / p.z, x = p.x * rz, y = p.y * rz;
  const auto image = [&](const Vec3<S>& world) {
    const Vec3<S> d = cam.rotation * world;
    return Vec2<S>{cam.fx * rz * (d.x - x * d.z), cam.fy * rz * (d.y - y * d.z)};
  };
  return {{cam.fx * x + cam.cx, cam.fy * y + cam.cy},
          image(patch_sum<S>(control, quadratic_weights_along_u(u, v))),
          image(patch_sum<S>(control, quadratic_weights_along_v(u, v)))};
}

// Steps after which one of the barycentric coordinates, which grow by du and dv a step, is 0; `edge`: u, v or w.
template <class S>
DYNGS_HD S steps_to_edge(S u, S v, S du, S dv, int& edge) {
  const S at[3] = {u, v, S(1) - u - v}, by[3] = {du, dv, -du - dv};
  S steps = kLargest<S>;
  for (int i = 0; i < 3; ++i) {
    const S t = max(at[i], S(0)) / -by[i];
    if (by[i] < S(0) && t < steps) steps = t, edge = i;
  }
  return steps;
}

// `control` (18,) of the patch, (u, v) the place from where.
template <class S, class P>
DYNGS_HD PatchEnd<S> patch_end(const Pinhole<S>& cam, const P& control, S u, S v, int direction) {
  const Vec2<S> step = pixel_step<S>(direction);
  const PatchJet<S> from = patch_jet(cam, control, u, v);
  const S det = from.by_u.x * from.by_v.y - from.by_u.y * from.by_v.x;
  const S du = (step.x * from.by_v.y - step.y * from.by_v.x) / det;
  const S dv = (step.y * from.by_u.x - step.x * from.by_u.y) / det;
  int edge = 0;
  const S steps = steps_to_edge(u, v, du, dv, edge);
  if (!(steps < S(4))) return {false, S(0), S(0), S(0), {S(0), S(0)}};
  PatchEnd<S> end{true, steps, u + steps * du, v + steps * dv, {S(0), S(0)}};
  const PatchJet<S> to = patch_jet(cam, control, end.u, end.v);
  const Vec2<S> along = edge == 0   ? to.by_v
                        : edge == 1 ? to.by_u
                                    : Vec2<S>{to.by_u.x - to.by_v.x, to.by_u.y - to.by_v.y};
  const S length = sqrt(along.x * along.x + along.y * along.y);
  const Vec2<S> normal{-along.y / length, along.x / length};
  const S sine = step.x * normal.x + step.y * normal.y;
  end.slope = {normal.x / sine, normal.y / sine};
  end.t = (to.at.x - from.at.x) * end.slope.x + (to.at.y - from.at.y) * end.slope.y;
  end.is_found = end.t <= S(1 + kEndSlack) && abs(sine) >= S(kLeastSine);
  end.t = clamp(end.t, S(0), S(1));
  return end;
}

// How much of a pixel the next one covers: the outline between them is `t` steps from the first's centre.
template <class S>
DYNGS_HD S covered_of_first(S t) {
  return max(S(0.5) - t, S(0));
}
template <class S>
DYNGS_HD S covered_of_second(S t) {
  return max(t - S(0.5), S(0));
}

}  // namespace dyngs

// Poses of control nodes at a time, and their as-rigid-as-possible penalty.
#pragma once

#include "math/skinning.hpp"

namespace dyngs {

// The number of values of a head of core/api.hpp's NodeSplines.
DYNGS_HD constexpr int64_t head_size(int head) { return head == 1 ? 4 : head == 3 ? 1 : 3; }

// The value of a cubic B-spline at a time; `at`: the first of its four control points that matter, `stride` apart.
template <class Row, class S>
DYNGS_HD S spline_value(const Row& at, int64_t stride, const S* fractions) {
  const S first = at[0], second = at[stride], third = at[2 * stride], fourth = at[3 * stride];
  return dot3(fractions[0], first, fractions[1], second, fractions[2], third) + fractions[3] * fourth;
}

// By how much a neighbour at `arm` of a node that turns by `turn` (R - I) is moved more than rigid motion has it.
template <class S>
DYNGS_HD Vec3<S> strain(const Mat3<S>& turn, const Vec3<S>& shift, const Vec3<S>& arm,
                        const Vec3<S>& neighbours_shift) {
  return neighbours_shift - shift - turn * arm;
}

// Adds the gradient by `turn`, from that by the strain.
template <class S>
DYNGS_HD void strain_vjp(const Vec3<S>& arm, const Vec3<S>& g, Mat3<S>& by_turn) {
  for (int i = 0; i < 3; ++i) {
    by_turn.m[i][0] -= g[i] * arm.x;
    by_turn.m[i][1] -= g[i] * arm.y;
    by_turn.m[i][2] -= g[i] * arm.z;
  }
}

}  // namespace dyngs

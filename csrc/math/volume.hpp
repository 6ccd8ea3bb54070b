// Volume rendering of a ray (Max 1995), and the space of a field: nested cubes around a centre, each twice the one inside it.
#pragma once

#include "math/scalar.hpp"

namespace dyngs {

// The space in which a field has a density.
template <class S>
struct FieldSpace {
  S centre[3];       // world
  S half;            // half the side of the innermost cube, world units
  int64_t cascades;  // number of cubes
  int64_t cells;     // along each axis of a cube

  DYNGS_HD S outermost() const {
    S side = half;
    for (int64_t k = 1; k < cascades; ++k) side += side;
    return side;
  }
};

// Max-norm of x - centre in units of the innermost cube's half side.
template <class S>
DYNGS_HD S cube_norm(const FieldSpace<S>& space, const S* x) {
  S norm = S(0);
  for (int a = 0; a < 3; ++a) norm = max(norm, abs(x[a] - space.centre[a]));
  return norm / space.half;
}

// Into [0, 1]^3: linear where there is one cube; else what is outside of the innermost is contracted, y -> (2 - 1/|y|) y/|y| in
// the max-norm (Barron et al. 2022), and the innermost cube is [1/4, 3/4]^3.
template <class S>
DYNGS_HD void unit_coords(const FieldSpace<S>& space, const S* x, S* unit) {
  const S norm = cube_norm(space, x), one = S(1);
  const S shrunk = space.cascades > 1 && norm > one ? (S(2) - one / norm) / norm : one;
  const S factor = shrunk / (space.half * (space.cascades > 1 ? S(4) : S(2)));
  for (int a = 0; a < 3; ++a) unit[a] = (x[a] - space.centre[a]) * factor + S(0.5);
}

// The cell that x lies in: its index in (cascades, cells, cells, cells) with z the slow axis, its lowest corner and its side;
// -1 outside of all cubes.
template <class S>
struct FieldCell {
  int64_t index;
  S corner[3];
  S side;
};
template <class S>
DYNGS_HD FieldCell<S> field_cell(const FieldSpace<S>& space, const S* x) {
  S half = space.half, norm = cube_norm(space, x);
  int64_t cascade = 0;
  while (norm > S(1) && cascade < space.cascades) norm *= S(0.5), half += half, ++cascade;
  FieldCell<S> cell{-1, {}, S(2) * half / static_cast<S>(space.cells)};
  if (cascade >= space.cascades) return cell;
  int64_t at[3];
  for (int a = 0; a < 3; ++a) {
    const S lowest = space.centre[a] - half, place = (x[a] - lowest) / cell.side;
    at[a] = place > S(0) ? static_cast<int64_t>(place) : 0;
    at[a] = at[a] < space.cells ? at[a] : space.cells - 1;
    cell.corner[a] = lowest + static_cast<S>(at[a]) * cell.side;
  }
  cell.index = ((cascade * space.cells + at[2]) * space.cells + at[1]) * space.cells + at[0];
  return cell;
}

// Distance from x along d to where it leaves the cell.
template <class S>
DYNGS_HD S exit_distance(const FieldCell<S>& cell, const S* x, const S* d) {
  S nearest = kLargest<S>;
  for (int a = 0; a < 3; ++a) {
    const S wall = cell.corner[a] + (d[a] > S(0) ? cell.side : S(0));
    if (d[a] != S(0)) nearest = min(nearest, max((wall - x[a]) / d[a], S(0)));
  }
  return nearest;
}

// Distances at which a ray enters and leaves the outermost cube, from `near` on; the first is not below the second where it
// misses the cube.
template <class S>
DYNGS_HD void clip_to_space(const FieldSpace<S>& space, const S* o, const S* d, S near, S& from, S& to) {
  const S half = space.outermost();
  from = near, to = kLargest<S>;
  for (int a = 0; a < 3; ++a) {
    const S offset = o[a] - space.centre[a];
    if (d[a] == S(0)) {
      if (!(abs(offset) < half)) to = near;
      continue;
    }
    const S one = (-half - offset) / d[a], two = (half - offset) / d[a];
    from = max(from, min(one, two)), to = min(to, max(one, two));
  }
}

}  // namespace dyngs

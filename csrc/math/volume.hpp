// The space of a field, nested cubes around a centre, each twice the one inside it; ray samples in it, and their
// volume rendering (Max 1995). Arrays are anything with []: pointers, or those of cuda/device.hpp.
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

// The samples of a ray whose middle lies in an occupied cell, one after the other.
template <class S>
struct RaySteps {
  S o[3], d[3];
  S at, to;      // where the next one may start, and where none does any more
  int64_t left;  // how many there may be

  // `march`: its space, and the sizes of its steps.
  template <class In>
  DYNGS_HD RaySteps(const In& march, const S (&origin)[3], const S (&direction)[3], S shift) : left(march.most) {
    for (int a = 0; a < 3; ++a) o[a] = origin[a], d[a] = direction[a];
    S from;
    clip_to_space(march.space, o, d, march.near, from, to);
    at = from + shift * max(march.step, from * march.cone);
  }

  // True if there is another sample, from `start` to `end` along the ray with midpoint x (3) in the world.
  template <class In, class Cells>
  DYNGS_HD bool next(const In& march, const Cells& occupied, S& start, S& end, S* x) {
    while (left > 0 && at < to) {
      const S length = max(march.step, at * march.cone), middle = at + S(0.5) * length;
      for (int a = 0; a < 3; ++a) x[a] = o[a] + middle * d[a];
      const FieldCell<S> cell = field_cell(march.space, x);
      if (cell.index < 0) return false;
      const bool is_here = occupied[cell.index];
      start = at, end = at + length;
      const S next = at + length * (is_here ? S(1) : max(S(1), ceil(exit_distance(cell, x, d) / length)));
      if (!(next > at)) left = is_here ? 1 : 0;  // the last: so far away that a step is lost in rounding
      at = next;
      if (!is_here) continue;
      --left;
      return true;
    }
    return false;
  }
};

template <class S, class In>
DYNGS_HD S opacity(const In& in, int64_t i) {
  return S(1) - std::exp(-in.densities[i] * (in.ends[i] - in.starts[i]));
}

template <class S, class In>
DYNGS_HD S middle_of(const In& in, int64_t i) {
  return S(0.5) * (in.starts[i] + in.ends[i]);
}

// Rendered values of a ray, or their gradients.
template <class S>
struct Sight {
  S colour[3], transmittance, depth;
};

// Of the samples [begin, end); writes the weight of each.
template <class S, class In, class Weights>
DYNGS_HD Sight<S> composite_ray(const In& in, int64_t begin, int64_t end, const Weights& weights) {
  Sight<S> seen{{S(0), S(0), S(0)}, S(1), S(0)};
  for (int64_t i = begin; i < end; ++i) {
    if (seen.transmittance < in.transmittance_min) {
      weights[i] = S(0);
      continue;
    }
    const S alpha = opacity<S>(in, i), weight = seen.transmittance * alpha;
    for (int c = 0; c < 3; ++c) seen.colour[c] += weight * in.colours[3 * i + c];
    seen.depth += weight * middle_of<S>(in, i);
    weights[i] = weight;
    seen.transmittance *= S(1) - alpha;
  }
  return seen;
}

// With v_i = g_colour . colour_i + g_depth middle_i, and t_i = T_i (1 - alpha_i) the transmittance behind sample i:
// dL/d density_i = length_i (t_i v_i - sum_{j > i} w_j v_j - g_transmittance T_end).
template <class S, class In, class Grads>
DYNGS_HD void composite_ray_vjp(const In& in, const Sight<S>& g, int64_t begin, int64_t end, const Grads& g_densities,
                                const Grads& g_colours) {
  S through = S(1);
  int64_t stop = begin;
  for (; stop < end && !(through < in.transmittance_min); ++stop) {
    const S alpha = opacity<S>(in, stop), weight = through * alpha;
    for (int c = 0; c < 3; ++c) g_colours[3 * stop + c] = weight * g.colour[c];
    through *= S(1) - alpha;
    g_densities[stop] = through;  // for now
  }
  // From the back, so that the sum behind the last sample is 0 exactly: its length may be 1e10.
  const S at_end = g.transmittance * through;
  S behind = S(0);
  for (int64_t i = stop; i-- > begin;) {
    const S before = i == begin ? S(1) : S(g_densities[i - 1]), after = g_densities[i];
    const S r = in.colours[3 * i], green = in.colours[3 * i + 1], b = in.colours[3 * i + 2];
    const S seen = dot3(g.colour[0], r, g.colour[1], green, g.colour[2], b) + g.depth * middle_of<S>(in, i);
    g_densities[i] = (in.ends[i] - in.starts[i]) * (after * seen - behind - at_end);
    behind += before * opacity<S>(in, i) * seen;
  }
  for (int64_t i = stop; i < end; ++i) {
    g_densities[i] = S(0);
    for (int c = 0; c < 3; ++c) g_colours[3 * i + c] = S(0);
  }
}

// Writes which samples are reached, and returns how many are.
template <class S, class In, class Flags>
DYNGS_HD int64_t mark_reached(const In& in, int64_t begin, int64_t end, const Flags& reached) {
  S through = S(1);
  int64_t count = 0;
  for (int64_t i = begin; i < end; ++i) {
    const bool is_reached = !(through < in.transmittance_min);
    reached[i] = is_reached;
    if (!is_reached) continue;
    through *= S(1) - opacity<S>(in, i);
    ++count;
  }
  return count;
}

}  // namespace dyngs

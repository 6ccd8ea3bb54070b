// Samples along rays through the occupied cells of a field's space, and what is seen along them. Each ray is one task's.
#include <algorithm>
#include <cmath>

#include "core/fields.hpp"
#include "cpu/parallel.hpp"

namespace dyngs {
namespace {

constexpr int64_t kGrain = 64;  // rays

// f(start, end, middle) for each sample of a ray; returns their number.
template <class S, class F>
int64_t march_ray(const March<S>& march, int64_t ray, F&& f) {
  const S *o = march.origins + 3 * ray, *d = march.directions + 3 * ray;
  S from, to;
  clip_to_space(march.space, o, d, march.near, from, to);
  int64_t found = 0;
  S at = from + march.shifts[ray] * max(march.step, from * march.cone);
  while (found < march.most && at < to) {
    const S length = max(march.step, at * march.cone), middle = at + S(0.5) * length;
    const S x[3] = {o[0] + middle * d[0], o[1] + middle * d[1], o[2] + middle * d[2]};
    const FieldCell<S> cell = field_cell(march.space, x);
    if (cell.index < 0) break;
    const bool is_here = march.occupied[cell.index];
    const S next = at + length * (is_here ? S(1) : max(S(1), ceil(exit_distance(cell, x, d) / length)));
    if (is_here) f(at, at + length, x), ++found;
    if (!(next > at)) break;  // so far away that a step is lost in rounding
    at = next;
  }
  return found;
}

template <class S>
S opacity(const RaySamples<S>& in, int64_t i) {
  return S(1) - std::exp(-in.densities[i] * (in.ends[i] - in.starts[i]));
}

template <class S>
S middle_of(const RaySamples<S>& in, int64_t i) {
  return S(0.5) * (in.starts[i] + in.ends[i]);
}

template <class S>
void composite_ray(const RaySamples<S>& in, const Composited<S>& out, int64_t ray) {
  S through = S(1), colour[3] = {}, depth = S(0);
  for (int64_t i = in.offsets[ray]; i < in.offsets[ray + 1]; ++i) {
    if (through < in.transmittance_min) {
      out.weights[i] = S(0);
      continue;
    }
    const S alpha = opacity(in, i), weight = through * alpha;
    for (int c = 0; c < 3; ++c) colour[c] += weight * in.colours[3 * i + c];
    depth += weight * middle_of(in, i);
    out.weights[i] = weight;
    through *= S(1) - alpha;
  }
  std::copy_n(colour, 3, out.colour + 3 * ray);
  out.transmittance[ray] = through, out.depth[ray] = depth;
}

// With v_i = g_colour . colour_i + g_depth middle_i, and t_i = T_i (1 - alpha_i) the transmittance behind sample i:
// dL/d density_i = length_i (t_i v_i - sum_{j > i} w_j v_j - g_transmittance T_end).
template <class S>
void composite_ray_vjp(const RaySamples<S>& in, const Composited<const S>& grads, int64_t ray, S* g_densities,
                       S* g_colours) {
  const S* g = grads.colour + 3 * ray;
  const int64_t begin = in.offsets[ray], end = in.offsets[ray + 1];
  const auto value = [&](int64_t i) {
    const S* c = in.colours + 3 * i;
    return dot3(g[0], c[0], g[1], c[1], g[2], c[2]) + grads.depth[ray] * middle_of(in, i);
  };
  S through = S(1);
  int64_t stop = begin;
  for (; stop < end && !(through < in.transmittance_min); ++stop) {
    const S weight = through * opacity(in, stop);
    for (int c = 0; c < 3; ++c) g_colours[3 * stop + c] = weight * g[c];
    through *= S(1) - opacity(in, stop);
    g_densities[stop] = through;  // for now
  }
  // From the back, so that the sum behind the last sample is 0 exactly: its length may be 1e10.
  const S at_end = grads.transmittance[ray] * through;
  S behind = S(0);
  for (int64_t i = stop; i-- > begin;) {
    const S before = i == begin ? S(1) : g_densities[i - 1], seen = value(i);
    g_densities[i] = (in.ends[i] - in.starts[i]) * (g_densities[i] * seen - behind - at_end);
    behind += before * opacity(in, i) * seen;
  }
  std::fill(g_densities + stop, g_densities + end, S(0));
  std::fill(g_colours + 3 * stop, g_colours + 3 * end, S(0));
}

template <class S, class F>
void for_each_ray(int64_t rays, int threads, F&& f) {
  parallel_for(rays, kGrain, threads, [&](int64_t begin, int64_t end) {
    for (int64_t ray = begin; ray < end; ++ray) f(ray);
  });
}

}  // namespace

template <class S>
void march_count(const March<S>& march, int64_t* counts) {
  for_each_ray<S>(march.rays, march.threads,
                  [&](int64_t ray) { counts[ray] = march_ray(march, ray, [](S, S, const S*) {}); });
}

template <class S>
void march_samples(const March<S>& march, const int64_t* offsets, const Samples<S>& out) {
  for_each_ray<S>(march.rays, march.threads, [&](int64_t ray) {
    int64_t i = offsets[ray];
    march_ray(march, ray, [&](S start, S end, const S* x) {
      if (i == offsets[ray + 1]) return;
      out.rays[i] = static_cast<int32_t>(ray), out.starts[i] = start, out.ends[i] = end;
      unit_coords(march.space, x, out.coords + 3 * i++);
    });
  });
}

template <class S>
void composite_forward(const RaySamples<S>& in, const Composited<S>& out) {
  for_each_ray<S>(in.rays, in.threads, [&](int64_t ray) { composite_ray(in, out, ray); });
}

template <class S>
void composite_backward(const RaySamples<S>& in, const Composited<const S>& grads, S* g_densities, S* g_colours) {
  for_each_ray<S>(in.rays, in.threads, [&](int64_t ray) { composite_ray_vjp(in, grads, ray, g_densities, g_colours); });
}

template <class S>
void reached_samples(const RaySamples<S>& in, bool* reached, int64_t* counts) {
  for_each_ray<S>(in.rays, in.threads, [&](int64_t ray) {
    S through = S(1);
    counts[ray] = 0;
    for (int64_t i = in.offsets[ray]; i < in.offsets[ray + 1]; ++i) {
      reached[i] = !(through < in.transmittance_min);
      if (!reached[i]) continue;
      through *= S(1) - opacity(in, i);
      ++counts[ray];
    }
  });
}

#define DYNGS_INSTANTIATE(S)                                                                     \
  template void march_count<S>(const March<S>&, int64_t*);                                       \
  template void march_samples<S>(const March<S>&, const int64_t*, const Samples<S>&);            \
  template void composite_forward<S>(const RaySamples<S>&, const Composited<S>&);                \
  template void composite_backward<S>(const RaySamples<S>&, const Composited<const S>&, S*, S*); \
  template void reached_samples<S>(const RaySamples<S>&, bool*, int64_t*);
DYNGS_INSTANTIATE(float)
DYNGS_INSTANTIATE(double)
#undef DYNGS_INSTANTIATE

}  // namespace dyngs

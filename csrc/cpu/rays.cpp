// Samples along rays through the occupied cells of a field's space, and volume rendering. Each ray is one task.
#include <algorithm>

#include "core/fields.hpp"
#include "cpu/parallel.hpp"

namespace dyngs {
namespace {

constexpr int64_t kGrain = 64;  // rays

template <class S>
RaySteps<S> steps_of(const March<S>& march, int64_t ray) {
  const S *o = march.origins + 3 * ray, *d = march.directions + 3 * ray;
  return {march, {o[0], o[1], o[2]}, {d[0], d[1], d[2]}, march.shifts[ray]};
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
  for_each_ray<S>(march.rays, march.threads, [&](int64_t ray) {
    RaySteps<S> steps = steps_of(march, ray);
    S start, end, x[3];
    int64_t count = 0;
    while (steps.next(march, march.occupied, start, end, x)) ++count;
    counts[ray] = count;
  });
}

template <class S>
void march_samples(const March<S>& march, const int64_t* offsets, const Samples<S>& out) {
  for_each_ray<S>(march.rays, march.threads, [&](int64_t ray) {
    RaySteps<S> steps = steps_of(march, ray);
    S start, end, x[3];
    for (int64_t i = offsets[ray]; i < offsets[ray + 1] && steps.next(march, march.occupied, start, end, x); ++i) {
      out.rays[i] = static_cast<int32_t>(ray), out.starts[i] = start, out.ends[i] = end;
      unit_coords(march.space, x, out.coords + 3 * i);
    }
  });
}

template <class S>
void composite_forward(const RaySamples<S>& in, const Composited<S>& out) {
  for_each_ray<S>(in.rays, in.threads, [&](int64_t ray) {
    const Sight<S> seen = composite_ray<S>(in, in.offsets[ray], in.offsets[ray + 1], out.weights);
    std::copy_n(seen.colour, 3, out.colour + 3 * ray);
    out.transmittance[ray] = seen.transmittance, out.depth[ray] = seen.depth;
  });
}

template <class S>
void composite_backward(const RaySamples<S>& in, const Composited<const S>& grads, S* g_densities, S* g_colours) {
  for_each_ray<S>(in.rays, in.threads, [&](int64_t ray) {
    const S* colour = grads.colour + 3 * ray;
    const Sight<S> g{{colour[0], colour[1], colour[2]}, grads.transmittance[ray], grads.depth[ray]};
    composite_ray_vjp(in, g, in.offsets[ray], in.offsets[ray + 1], g_densities, g_colours);
  });
}

template <class S>
void reached_samples(const RaySamples<S>& in, bool* reached, int64_t* counts) {
  for_each_ray<S>(in.rays, in.threads, [&](int64_t ray) {
    counts[ray] = mark_reached<S>(in, in.offsets[ray], in.offsets[ray + 1], reached);
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

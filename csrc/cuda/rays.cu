// Samples along rays and volume rendering (math/volume.hpp): one thread per ray, which visits its samples in order like
// the CPU. One kernel both counts samples and writes them, so that both round alike.
//
// Limits, H100 (3.35 TB/s; some 0.5 us for a read that must be waited for). Per sample: marching 24 bytes, and per step a byte of
// a grid that stays in the second-level cache; compositing 28 bytes forward, 40 backward: 7 to 12 ps. Rays of a step, thousands,
// are too few to hide the wait for each sample: 32 samples of each take some 20 us, whatever the number of rays.
#include "cuda/api.hpp"
#include "cuda/device.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 128;

__device__ int64_t this_ray() { return int64_t{blockIdx.x} * kThreads + threadIdx.x; }

// Writes the counts, or where these are null the samples.
__global__ void __launch_bounds__(kThreads)
    march_kernel(March<float> march, int64_t* counts, const int64_t* offsets, Samples<float> out) {
  const int64_t ray = this_ray();
  if (ray >= march.rays) return;
  const Array<const float> from = global(march.origins) + 3 * ray, along = global(march.directions) + 3 * ray;
  const float o[3] = {from[0], from[1], from[2]}, d[3] = {along[0], along[1], along[2]};
  RaySteps<float> steps(march, o, d, global(march.shifts)[ray]);
  const Array<const bool> occupied = global(march.occupied);
  const bool counts_only = counts != nullptr;
  const int64_t begin = counts_only ? 0 : int64_t{global(offsets)[ray]};
  const int64_t end = counts_only ? march.most : int64_t{global(offsets)[ray + 1]};
  int64_t i = begin;
  float first, last, x[3], unit[3];
  for (; i < end && steps.next(march, occupied, first, last, x); ++i) {
    if (counts_only) continue;
    global(out.rays)[i] = static_cast<int32_t>(ray);
    global(out.starts)[i] = first;
    global(out.ends)[i] = last;
    unit_coords(march.space, x, unit);
    for (int a = 0; a < 3; ++a) global(out.coords)[3 * i + a] = unit[a];
  }
  if (counts_only) global(counts)[ray] = i;
}

// Samples whose accesses are checked in the emulation.
struct RayArrays {
  Array<const float> densities, colours, starts, ends;
  float transmittance_min;
};
__device__ RayArrays arrays_of(const RaySamples<float>& in) {
  return {global(in.densities), global(in.colours), global(in.starts), global(in.ends), in.transmittance_min};
}

__global__ void __launch_bounds__(kThreads) composite_kernel(RaySamples<float> in, Composited<float> out) {
  const int64_t ray = this_ray();
  if (ray >= in.rays) return;
  const int64_t begin = global(in.offsets)[ray], end = global(in.offsets)[ray + 1];
  const Sight<float> seen = composite_ray<float>(arrays_of(in), begin, end, global(out.weights));
  for (int c = 0; c < 3; ++c) global(out.colour)[3 * ray + c] = seen.colour[c];
  global(out.transmittance)[ray] = seen.transmittance;
  global(out.depth)[ray] = seen.depth;
}

__global__ void __launch_bounds__(kThreads)
    composite_backward_kernel(RaySamples<float> in, Composited<const float> grads, float* g_densities,
                              float* g_colours) {
  const int64_t ray = this_ray();
  if (ray >= in.rays) return;
  const Array<const float> colour = global(grads.colour) + 3 * ray;
  const Sight<float> g{{colour[0], colour[1], colour[2]}, global(grads.transmittance)[ray], global(grads.depth)[ray]};
  const int64_t begin = global(in.offsets)[ray], end = global(in.offsets)[ray + 1];
  composite_ray_vjp(arrays_of(in), g, begin, end, global(g_densities), global(g_colours));
}

__global__ void __launch_bounds__(kThreads) reached_kernel(RaySamples<float> in, bool* reached, int64_t* counts) {
  const int64_t ray = this_ray();
  if (ray >= in.rays) return;
  const int64_t begin = global(in.offsets)[ray], end = global(in.offsets)[ray + 1];
  global(counts)[ray] = mark_reached<float>(arrays_of(in), begin, end, global(reached));
}

LaunchGrid grid_of(int64_t rays) { return {blocks_for(rays, kThreads), kThreads}; }

}  // namespace

void march_count(const March<float>& march, int64_t* counts, Stream stream) {
  launch("march", grid_of(march.rays), stream, march_kernel, march, counts, static_cast<const int64_t*>(nullptr),
         Samples<float>{});
}

void march_samples(const March<float>& march, const int64_t* offsets, const Samples<float>& out, Stream stream) {
  launch("march", grid_of(march.rays), stream, march_kernel, march, static_cast<int64_t*>(nullptr), offsets, out);
}

void composite_forward(const RaySamples<float>& in, const Composited<float>& out, Stream stream) {
  launch("composite", grid_of(in.rays), stream, composite_kernel, in, out);
}

void composite_backward(const RaySamples<float>& in, const Composited<const float>& grads, float* g_densities,
                        float* g_colours, Stream stream) {
  launch("composite_backward", grid_of(in.rays), stream, composite_backward_kernel, in, grads, g_densities, g_colours);
}

void reached_samples(const RaySamples<float>& in, bool* reached, int64_t* counts, Stream stream) {
  launch("reached", grid_of(in.rays), stream, reached_kernel, in, reached, counts);
}

}  // namespace dyngs::cuda

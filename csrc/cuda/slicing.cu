// Slicing of 4D Gaussians (math/slicing.hpp), one thread per Gaussian.
//
// Limits, H100 (3.35 TB/s, 67 TFLOP/s), per Gaussian: forward 68 bytes read and 92 written, 48 ps; 600 operations, 9 ps: bound
// by memory. Backward 188 bytes read and 68 written, 76 ps.
// Harmonics over time: a thread per number of the result, backward a warp per Gaussian.
#include "cuda/api.hpp"
#include "cuda/reduce.hpp"
#include "cuda/rows.hpp"
#include "math/slicing.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 128;

__device__ SpaceTime<float> load_space_time(const SpaceTimeGaussians<float>& in, int64_t i) {
  const Vec3<float> logs = load3(in.log_scales, i);
  const float log_scales[4] = {logs.x, logs.y, logs.z, global(in.log_spans)[i]};
  return space_time(load4(in.quats, i), load4(in.right_quats, i), log_scales);
}

__global__ void __launch_bounds__(kThreads)
    slice_kernel(SpaceTimeGaussians<float> in, SliceTime<float> at, Slice<float> out) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= in.count) return;
  const SpaceTime<float> f = load_space_time(in, i);
  const SlicedShape<float> shape = sliced_shape(f);
  const float delay = at.time - global(in.times)[i];
  store3(out.means, i, sliced_mean(load3(in.means, i), f.velocity, delay));
  global(out.logit_opacities)[i] = visibility(f, delay, global(in.logit_opacities)[i], at.most_faded).logit;
  store4(out.quats, i, shape.quat);
  store3(out.log_scales, i, load_vec3(shape.log_scales));
  DYNGS_UNROLL
  for (int k = 0; k < 4; ++k) store3(out.basis, 4 * i + k, shape.basis[k]);
}

__global__ void __launch_bounds__(kThreads)
    slice_backward_kernel(SpaceTimeGaussians<float> in, SliceTime<float> at, Slice<const float> slice,
                          SliceGrads<float> g, SpaceTimeGrads<float> out) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= in.count) return;
  const SpaceTime<float> f = load_space_time(in, i);
  const Vec3<float> logs = load3(slice.log_scales, i), by_logs = load3(g.log_scales, i);
  SlicedShape<float> shape{load4(slice.quats, i), {logs.x, logs.y, logs.z}, {}};
  DYNGS_UNROLL
  for (int k = 0; k < 4; ++k) shape.basis[k] = load3(slice.basis, 4 * i + k);
  const SliceGrad<float> by{
      load3(g.means, i), load4(g.quats, i), {by_logs.x, by_logs.y, by_logs.z}, global(g.logit_opacities)[i]};
  const float delay = at.time - global(in.times)[i];
  const SpaceTimeGrad<float> found = slice_vjp(f, shape, delay, global(in.logit_opacities)[i], at.most_faded, by);
  store3(out.means, i, found.mean);
  global(out.times)[i] = found.time;
  store4(out.quats, i, found.left), store4(out.right_quats, i, found.right);
  store3(out.log_scales, i, load_vec3(found.log_scales));
  global(out.log_spans)[i] = found.log_scales[3];
  global(out.logit_opacities)[i] = found.logit;
}

__global__ void __launch_bounds__(kThreads) condition_kernel(SpaceTimeGaussians<float> in, Conditional<float> out) {
  const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= in.count) return;
  const SpaceTime<float> f = load_space_time(in, i);
  const SlicedShape<float> shape = sliced_shape(f);
  store4(out.quats, i, shape.quat);
  store3(out.log_scales, i, load_vec3(shape.log_scales));
  store3(out.velocities, i, f.velocity);
  global(out.log_deviations)[i] = log_deviation(f);
}

__global__ void __launch_bounds__(kThreads) time_harmonics_kernel(TimeHarmonics<float> in, float* out) {
  const int64_t at = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (at >= in.count * in.width) return;
  const int64_t i = at / in.width, j = at % in.width;
  float sum = global(in.sh)[at];
  if (global(in.seen)[i]) {
    const int64_t row = in.rows != nullptr ? static_cast<int64_t>(global(in.rows)[i]) : i;
    const Wave<float> first = first_wave(static_cast<float>(global(in.elapsed)[i]));
    Wave<float> wave = first;
    for (int64_t n = 0; n < in.waves; ++n, wave = next_wave(wave, first))
      sum += wave.cosine * global(in.sh_time)[(row * in.waves + n) * in.width + j];
  }
  global(out)[at] = sum;
}

__global__ void __launch_bounds__(kThreads)
    time_harmonics_backward_kernel(TimeHarmonics<float> in, const float* g, float* by_sh_time, float* by_elapsed) {
  const int64_t i = (int64_t{blockIdx.x} * kThreads + threadIdx.x) / kWarpSize;
  const int lane = static_cast<int>(threadIdx.x) % kWarpSize;
  if (i >= in.count) return;
  const int64_t row = in.rows != nullptr ? static_cast<int64_t>(global(in.rows)[i]) : i;
  const bool seen = global(in.seen)[i];
  const Wave<float> first = first_wave(static_cast<float>(global(in.elapsed)[i]));
  Wave<float> wave = first;
  float slope = 0.f;
  for (int64_t n = 0; n < in.waves; ++n, wave = next_wave(wave, first))
    for (int64_t j = lane; j < in.width; j += kWarpSize) {
      const int64_t at = (row * in.waves + n) * in.width + j;
      const float by = seen ? static_cast<float>(global(g)[i * in.width + j]) : 0.f;
      if (seen) slope -= 6.2831853f * static_cast<float>(n + 1) * wave.sine * by * global(in.sh_time)[at];
      global(by_sh_time)[at] = wave.cosine * by;
    }
  slope = warp_sum(slope);
  if (lane == 0) global(by_elapsed)[i] = slope;
}

}  // namespace

void time_harmonics(const TimeHarmonics<float>& in, float* out, Stream stream) {
  launch("time_harmonics", {blocks_for(in.count * in.width, kThreads), kThreads}, stream, time_harmonics_kernel, in,
         out);
}

void time_harmonics_backward(const TimeHarmonics<float>& in, const float* g, float* by_sh_time, float* by_elapsed,
                             Stream stream) {
  launch("time_harmonics_backward", {blocks_for(in.count * kWarpSize, kThreads), kThreads}, stream,
         time_harmonics_backward_kernel, in, g, by_sh_time, by_elapsed);
}

void slice_forward(const SpaceTimeGaussians<float>& in, const SliceTime<float>& at, const Slice<float>& out,
                   Stream stream) {
  launch("slice", {blocks_for(in.count, kThreads), kThreads}, stream, slice_kernel, in, at, out);
}

void slice_backward(const SpaceTimeGaussians<float>& in, const SliceTime<float>& at, const Slice<const float>& slice,
                    const SliceGrads<float>& g, const SpaceTimeGrads<float>& out, Stream stream) {
  launch("slice_backward", {blocks_for(in.count, kThreads), kThreads}, stream, slice_backward_kernel, in, at, slice, g,
         out);
}

void condition(const SpaceTimeGaussians<float>& in, const Conditional<float>& out, Stream stream) {
  launch("condition", {blocks_for(in.count, kThreads), kThreads}, stream, condition_kernel, in, out);
}

}  // namespace dyngs::cuda

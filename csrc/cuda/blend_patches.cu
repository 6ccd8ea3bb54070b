// Pixels as weighted means of themselves and their neighbours, and the vjp, which gathers (math/patch_blend.hpp): one
// thread per pixel.
//
// Limits, H100 (3.35 TB/s). Per pixel, four channels: 20 bytes written, 12 read once, the rest from caches: 10 ps. Backward 60
// bytes: 18 ps, and the stars of four neighbours, some 300 operations.
#include "cuda/api.hpp"
#include "cuda/device.hpp"
#include "math/patch_blend.hpp"

namespace dyngs::cuda {
namespace {

constexpr int kThreads = 128;

// Arrays whose accesses are checked in the emulation.
struct ImageArrays {
  Array<const int32_t> rows, ids;
  Array<const float> colours, crossings;
  int width, height, channels;
};
__device__ ImageArrays arrays_of(const PatchImage<float>& in) {
  return {global(in.rows), global(in.ids), global(in.colours), global(in.crossings), in.width, in.height, in.channels};
}

struct GradArrays {
  Array<const float> image, transmittance;
  int channels;

  __device__ float operator()(int64_t pixel, int c) const {
    return c == channels ? transmittance[pixel] : image[pixel * channels + c];
  }
};

using Star = PixelStar<float, ImageArrays>;

__device__ Star star_of(const PatchImage<float>& in, const ImageArrays& arrays, int64_t pixel) {
  const int64_t plane = int64_t{in.width} * in.height;
  return Star(arrays, pixel / plane, static_cast<int>(pixel % in.width), static_cast<int>(pixel % plane / in.width));
}

__global__ void __launch_bounds__(kThreads) blend_kernel(PatchImage<float> in, BlendedPatches<float> out) {
  const int64_t pixel = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (pixel >= in.views * in.width * in.height) return;
  const ImageArrays arrays = arrays_of(in);
  const Star star = star_of(in, arrays, pixel);
  for (int c = 0; c < in.channels; ++c) global(out.image)[pixel * in.channels + c] = star.blended(c);
  global(out.transmittance)[pixel] = star.blended(in.channels);
}

__global__ void __launch_bounds__(kThreads)
    blend_backward_kernel(PatchImage<float> in, BlendedPatches<const float> grads, PatchGrads<float> out) {
  const int64_t pixel = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (pixel >= in.views * in.width * in.height) return;
  const ImageArrays arrays = arrays_of(in);
  const GradArrays g{global(grads.image), global(grads.transmittance), in.channels};
  const Star star = star_of(in, arrays, pixel);
  const int64_t row = star.row();
  float by_mean[2] = {};
  for (int c = 0; row >= 0 && c < in.channels; ++c) {
    const float by_colour = gathered(star, g, c);
    global(out.colours)[row * in.channels + c] = by_colour;
    for (int axis = 0; axis < 2; ++axis) by_mean[axis] -= by_colour * star.slope(axis, c);
  }
  for (int axis = 0; axis < 2; ++axis) {
    if (row >= 0) global(out.means)[2 * row + axis] = by_mean[axis];
    global(out.crossings)[star.crossing(2 * axis)] = star.has(2 * axis) ? crossing_grad(star, g, 2 * axis) : 0.f;
  }
}

LaunchGrid grid_of(const PatchImage<float>& in) {
  return {blocks_for(in.views * in.width * in.height, kThreads), kThreads};
}

}  // namespace

void blend_patches_forward(const PatchImage<float>& in, const BlendedPatches<float>& out, Stream stream) {
  launch("blend_patches", grid_of(in), stream, blend_kernel, in, out);
}

void blend_patches_backward(const PatchImage<float>& in, const BlendedPatches<const float>& grads,
                            const PatchGrads<float>& out, Stream stream) {
  launch("blend_patches_backward", grid_of(in), stream, blend_backward_kernel, in, grads, out);
}

}  // namespace dyngs::cuda

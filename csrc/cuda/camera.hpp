// The camera of a view, read from the GPU's memory.
#pragma once

#include "cuda/device.hpp"
#include "math/projection.hpp"

namespace dyngs::cuda {

// `viewmats` (V, 4, 4) and `intrinsics` (V, 3, 3), see pinhole().
template <class S>
__device__ Pinhole<S> load_camera(const float* viewmats, const float* intrinsics, int64_t view, int width, int height) {
  S viewmat[16], inner[9];
  for (int i = 0; i < 16; ++i) viewmat[i] = static_cast<S>(static_cast<float>(global(viewmats)[16 * view + i]));
  for (int i = 0; i < 9; ++i) inner[i] = static_cast<S>(static_cast<float>(global(intrinsics)[9 * view + i]));
  return pinhole(viewmat, inner, width, height);
}

}  // namespace dyngs::cuda

// Rows of three and of four numbers: vectors and quaternions of Gaussians.
#pragma once

#include "cuda/device.hpp"
#include "math/quaternion.hpp"

namespace dyngs::cuda {

__device__ inline Vec3<float> load3(const float* rows, int64_t i) {
  const Array<const float> from = global(rows) + 3 * i;
  return {from[0], from[1], from[2]};
}
__device__ inline void store3(float* rows, int64_t i, const Vec3<float>& v) {
  const Array<float> to = global(rows) + 3 * i;
  to[0] = v.x, to[1] = v.y, to[2] = v.z;
}
__device__ inline Quat<float> load4(const float* rows, int64_t i) {
  const Array<const float> q = global(rows) + 4 * i;
  return {q[0], q[1], q[2], q[3]};
}
__device__ inline void store4(float* rows, int64_t i, const Quat<float>& q) {
  const Array<float> to = global(rows) + 4 * i;
  to[0] = q.w, to[1] = q.x, to[2] = q.y, to[3] = q.z;
}

}  // namespace dyngs::cuda

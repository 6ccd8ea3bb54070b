// Sums over the lanes of a warp and the threads of a block, always in the same order.
#pragma once

#include "cuda/device.hpp"

namespace dyngs::cuda {

// The same sum in every lane.
template <class T>
__device__ __forceinline__ T warp_sum(T value) {
  for (int step = kWarpSize / 2; step > 0; step /= 2) value += __shfl_xor_sync(kAllLanes, value, step);
  return value;
}

template <class T>
__device__ __forceinline__ T warp_max(T value) {
  for (int step = kWarpSize / 2; step > 0; step /= 2) {
    const T other = __shfl_xor_sync(kAllLanes, value, step);
    value = other > value ? other : value;
  }
  return value;
}

// The sum over all threads of the block, in its thread 0. `partials`: shared, one place per warp. Ends with a barrier.
template <class T>
__device__ __forceinline__ T block_sum(T value, const Array<T>& partials) {
  const int thread = static_cast<int>(threadIdx.x), warps = static_cast<int>(blockDim.x) / kWarpSize;
  value = warp_sum(value);
  if (thread % kWarpSize == 0) partials[thread / kWarpSize] = value;
  __syncthreads();
  T total{};
  if (thread == 0)
    for (int w = 0; w < warps; ++w) total += static_cast<T>(partials[w]);
  __syncthreads();
  return total;
}

}  // namespace dyngs::cuda

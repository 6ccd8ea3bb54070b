// The common header of all kernels: CUDA under nvcc, otherwise the emulation in which the tests run the same source.
// Beside CUDA itself a kernel uses four wrappers, which cost nothing on a GPU:
//   Array<T>, global(pointer)                arrays whose accesses the emulation checks; plain pointers for nvcc
//   atomic_add(array, index, value)
//   DYNGS_SHARED(T, name, count), DYNGS_DYNAMIC_SHARED(T, name)   arrays in shared memory
//   launch(name, grid, stream, kernel, arguments...)
// `auto x = array[i]` would name the place, not the value: write the type.
#pragma once

#include <cstdint>
#include <stdexcept>
#include <string>

#include "core/api.hpp"

#if defined(__CUDACC__)
#include <cuda_runtime.h>
#define DYNGS_UNROLL _Pragma("unroll")
#define DYNGS_UNROLL_BY_4 _Pragma("unroll 4")
#define DYNGS_SHARED(T, name, count) \
  __shared__ T name##_memory[count]; \
  T* const name = name##_memory
#define DYNGS_DYNAMIC_SHARED(T, name)                            \
  extern __shared__ __align__(16) unsigned char name##_memory[]; \
  T* const name = reinterpret_cast<T*>(name##_memory)
#else
#define DYNGS_UNROLL
#define DYNGS_UNROLL_BY_4
#include "tests/cuda_on_cpu.hpp"
#endif

namespace dyngs::cuda {

using Stream = void*;  // a cudaStream_t; the emulation ignores it

inline constexpr int kWarpSize = 32;
inline constexpr uint32_t kAllLanes = 0xffffffffu;

// Blocks, threads of each, and bytes of dynamic shared memory.
struct LaunchGrid {
  int64_t blocks;
  int threads;
  int64_t shared_bytes = 0;
};

inline int64_t blocks_for(int64_t items, int64_t per_block) { return (items + per_block - 1) / per_block; }

#if defined(__CUDACC__)

template <class T>
using Array = T*;

template <class T>
__device__ __forceinline__ T* global(T* p) {
  return p;
}
__device__ __forceinline__ uint32_t float_bits(float x) { return __float_as_uint(x); }
template <class T>
__device__ __forceinline__ T atomic_add(T* array, int64_t index, T value) {
  return atomicAdd(array + index, value);
}

inline void check(cudaError_t error, const char* what) {
  if (error != cudaSuccess) throw std::runtime_error(std::string(what) + ": " + cudaGetErrorString(error));
}

// Starts a kernel; nothing is started for no blocks.
template <class... Parameters, class... Arguments>
void launch(const char* name, const LaunchGrid& grid, Stream stream, void (*kernel)(Parameters...),
            const Arguments&... arguments) {
  if (grid.blocks == 0) return;
  if (grid.blocks > INT32_MAX) throw std::length_error(std::string(name) + ": more than 2^31 - 1 blocks");
  kernel<<<static_cast<unsigned>(grid.blocks), grid.threads, grid.shared_bytes, static_cast<cudaStream_t>(stream)>>>(
      arguments...);
  check(cudaGetLastError(), name);
}

// Copies to the host and waits for it: the only way in which this library synchronises.
inline void read_back(void* to, const void* from, int64_t bytes, Stream stream) {
  check(cudaMemcpyAsync(to, from, bytes, cudaMemcpyDeviceToHost, static_cast<cudaStream_t>(stream)), "reading back");
  check(cudaStreamSynchronize(static_cast<cudaStream_t>(stream)), "reading back");
}

inline void note_array(void*, int64_t, int64_t) {}

#else

inline uint32_t float_bits(float x) { return std::bit_cast<uint32_t>(x); }

template <class... Parameters, class... Arguments>
void launch(const char* name, const LaunchGrid& grid, Stream, void (*kernel)(Parameters...),
            const Arguments&... arguments) {
  emulated::machine.run(name, {grid.blocks, grid.threads, grid.shared_bytes}, [&] { kernel(arguments...); });
}

inline void read_back(void* to, const void* from, int64_t bytes, Stream) {
  std::memcpy(to, from, bytes);
  ++emulated::machine.host_reads;
}

inline void note_array(void* begin, int64_t bytes, int64_t element) { emulated::split(begin, bytes, element); }

#endif

// Memory of the device lent by the caller, cut into arrays. Without memory it only counts.
class Workspace {
 public:
  Workspace(void* memory, int64_t bytes) : memory_(static_cast<char*>(memory)), bytes_(bytes) {}

  template <class T>
  T* take(int64_t count) {
    const int64_t begin = (taken_ + kAlignment - 1) / kAlignment * kAlignment, bytes = count * int64_t{sizeof(T)};
    taken_ = begin + bytes;
    if (memory_ == nullptr) return nullptr;
    if (taken_ > bytes_) throw std::length_error("the workspace has " + std::to_string(bytes_) + " bytes, too few");
    note_array(memory_ + begin, bytes, sizeof(T));
    return reinterpret_cast<T*>(memory_ + begin);
  }
  int64_t taken() const { return taken_; }

 private:
  static constexpr int64_t kAlignment = 256;  // that of cudaMalloc
  char* memory_;
  int64_t bytes_, taken_ = 0;
};

}  // namespace dyngs::cuda

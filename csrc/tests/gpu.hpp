// The device of the CUDA kernel tests: the emulated GPU, or with DYNGS_ON_GPU a real one.
#pragma once

#include <string>
#include <vector>

#include "core/api.hpp"
#include "cuda/api.hpp"
#if defined(DYNGS_ON_GPU)
#include <cuda_runtime.h>

#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <stdexcept>
#else
#include <utility>

#include "cuda/device.hpp"
#endif

namespace check {

using namespace dyngs;

#if defined(DYNGS_ON_GPU)

inline void succeed(cudaError_t error) {
  if (error != cudaSuccess) throw std::runtime_error(cudaGetErrorString(error));
}

// An allocation of the GPU's memory: that of the emulation, as far as tests use it.
template <class T>
class Memory {
 public:
  explicit Memory(int64_t count, const std::string& = "") : count_(count) {
    succeed(cudaMalloc(&memory_, count * sizeof(T) + 1));
    succeed(cudaMemset(memory_, 0xff, count * sizeof(T)));
  }
  explicit Memory(const std::vector<T>& values, const std::string& name = "")
      : Memory(static_cast<int64_t>(values.size()), name) {
    const auto copy = std::make_unique<T[]>(values.size());
    std::copy(values.begin(), values.end(), copy.get());
    succeed(cudaMemcpy(memory_, copy.get(), values.size() * sizeof(T), cudaMemcpyHostToDevice));
  }
  Memory(const Memory&) = delete;
  Memory& operator=(const Memory&) = delete;
  ~Memory() { cudaFree(memory_); }

  T* get() { return static_cast<T*>(memory_); }
  int64_t count() const { return count_; }
  std::vector<T> values() const {
    const auto copy = std::make_unique<T[]>(count_);
    succeed(cudaMemcpy(copy.get(), memory_, count_ * sizeof(T), cudaMemcpyDeviceToHost));
    return std::vector<T>(copy.get(), copy.get() + count_);
  }

 private:
  void* memory_ = nullptr;
  int64_t count_;
};

// A GPU schedules as it likes: once more, and again.
template <class Run>
void in_other_orders(const Run& run) {
  for (int k = 0; k < 3; ++k) run();
}

// Ends the program with the code that CTest knows for "skipped" where there is no GPU.
inline void skip_without_gpu() {
  int count = 0;
  if (cudaGetDeviceCount(&count) == cudaSuccess && count > 0) return;
  std::printf("skipped: no CUDA GPU here\n");
  std::exit(77);
}

#else

using cuda::emulated::Memory;

// Calls run() with the blocks and threads of every launch in other orders than the first.
template <class Run>
void in_other_orders(const Run& run) {
  using Order = cuda::emulated::Schedule::Order;
  for (const auto& [order, seed] : {std::pair{Order::kReversed, 0u}, {Order::kShuffled, 1u}, {Order::kShuffled, 2u}}) {
    cuda::emulated::machine.schedule = {order, seed};
    run();
  }
  cuda::emulated::machine.schedule = {};
}

inline void skip_without_gpu() {}

#endif

}  // namespace check

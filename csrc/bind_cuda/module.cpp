// The extension module for CUDA GPUs: the bindings of csrc/bind, compiled for arrays in a GPU's memory, over the kernels of
// csrc/cuda. Compiled against their emulation (csrc/tests) it is a module for arrays of the CPU, which the tests run.
#include "bind/arrays.hpp"
#include "bind_cuda/queue.hpp"
#if !defined(DYNGS_EMULATED)
#include <cuda_runtime_api.h>
#else
#include "cuda/device.hpp"
#endif

namespace dyngs {
namespace {

#if !defined(DYNGS_EMULATED)

// Versions as CUDA writes them, 13000 for 13.0; 0 where there is none.
int runtime_version() {
  int version = 0;
  return cudaRuntimeGetVersion(&version) == cudaSuccess ? version : 0;
}
int driver_version() {
  int version = 0;
  return cudaDriverGetVersion(&version) == cudaSuccess ? version : 0;
}

#else

// Tells the emulation of an array that a kernel is about to be given.
void note_memory(uintptr_t address, int64_t bytes, int64_t element) {
  void* begin = reinterpret_cast<void*>(address);
  cuda::emulated::Regions& regions = cuda::emulated::regions();
  regions.remove(begin, bytes);
  regions.add(std::make_unique<cuda::emulated::Region>("an array of torch", begin, bytes, element, true));
}

#endif

}  // namespace
}  // namespace dyngs

NB_MODULE(DYNGS_MODULE, module) {
  module.def(
      "use_queue",
      [](int device, uintptr_t stream) { dyngs::cuda::use_queue(device, reinterpret_cast<void*>(stream)); },
      nb::arg("device"), nb::arg("stream"), "Makes all later calls of this thread go to a cudaStream_t of a GPU.");
#if !defined(DYNGS_EMULATED)
  module.def("runtime_version", dyngs::runtime_version);
  module.def("driver_version", dyngs::driver_version);
#else
  module.def("note_memory", dyngs::note_memory);
  module.def("host_reads", [] { return dyngs::cuda::emulated::machine.host_reads; });
#endif
  dyngs::bind_ops(module);
}

#include "bind_cuda/queue.hpp"

#if defined(DYNGS_EMULATED)
#include "cuda/device.hpp"
#else
#include <cuda_runtime_api.h>

#include <stdexcept>
#include <string>
#endif

namespace nb = nanobind;

namespace dyngs::cuda {
namespace {

struct Queue {
  int device = 0;
  Stream stream = nullptr;
};
thread_local Queue queue;

}  // namespace

void use_queue(int device, Stream stream) {
  queue = {device, stream};
#if !defined(DYNGS_EMULATED)
  if (const cudaError_t error = cudaSetDevice(device); error != cudaSuccess)
    throw std::runtime_error(std::string("GPU ") + std::to_string(device) + ": " + cudaGetErrorString(error));
#endif
}

Stream current_stream() { return queue.stream; }

Borrowed::Borrowed(int64_t bytes) {
  const nb::gil_scoped_acquire held;
  nb::object tensor = nb::module_::import_("dyngs.ops.native").attr("lend")(bytes, queue.device);
  lent_ = {reinterpret_cast<void*>(nb::cast<uintptr_t>(tensor.attr("data_ptr")())), bytes};
  owner_ = tensor.release().ptr();
#if defined(DYNGS_EMULATED)
  emulated::regions().remove(lent_.memory, bytes);  // what lay here before has been given back
#endif
}

Borrowed::~Borrowed() {
  const nb::gil_scoped_acquire held;
  Py_XDECREF(owner_);
}

nb::object Borrowed::tensor() const { return nb::borrow(owner_); }

void Borrowed::note([[maybe_unused]] int64_t element) const {
#if defined(DYNGS_EMULATED)
  note_array(lent_.memory, lent_.bytes, element);
#endif
}

}  // namespace dyngs::cuda

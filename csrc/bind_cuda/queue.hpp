// The target of calls per thread: a GPU, one of its streams, and torch as the allocator of GPU memory.
#pragma once

#include <nanobind/nanobind.h>

#include "cuda/api.hpp"

namespace dyngs::cuda {

// Makes all later calls of this thread go there.
void use_queue(int device, Stream stream);
Stream current_stream();

// `bytes` of the GPU's memory, a tensor of torch. It may be given back as soon as the work is queued: torch lends it anew
// only to what comes later on the stream.
class Borrowed {
 public:
  explicit Borrowed(int64_t bytes);
  Borrowed(const Borrowed&) = delete;
  Borrowed& operator=(const Borrowed&) = delete;
  ~Borrowed();

  const Lent& lent() const { return lent_; }
  // The memory as an array of the kernels.
  template <class T>
  T* array() const {
    note(sizeof(T));
    return static_cast<T*>(lent_.memory);
  }
  // The tensor itself, for Python.
  nanobind::object tensor() const;

 private:
  void note(int64_t element) const;  // for the emulation's checks
  Lent lent_{};
  PyObject* owner_ = nullptr;
};

}  // namespace dyngs::cuda

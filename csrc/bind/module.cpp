// The extension module, one per instruction set: _core_v2, _core_v3, _core_v4, the baseline's bindings with the kernels of
// that set. Separate shared objects, so that no inline function compiled for a newer processor can be linked into an older
// one's code.
#include <exception>
#include <new>
#include <string>

#include "bind/arrays.hpp"
#include "core/isa.hpp"
#include "cpu/memory.hpp"

// Turns a failed allocation into the one line of error that any other request too large gets.
static void refuse_for_memory(const std::exception_ptr& exception, void*) {
  try {
    std::rethrow_exception(exception);
  } catch (const std::bad_alloc&) {
    const std::string left = dyngs::gigabytes(dyngs::available_memory());
    nb::object type = nb::module_::import_("dyngs.core.errors").attr("DyngsError");
    PyErr_SetString(type.ptr(), ("out of memory: " + left + " are available; ask for less at once").c_str());
  }
}

NB_MODULE(DYNGS_MODULE, module) {
  nb::register_exception_translator(refuse_for_memory);
  module.def("best_isa", dyngs::best_isa);
  dyngs::bind_ops(module);
}

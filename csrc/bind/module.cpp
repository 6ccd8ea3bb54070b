// The extension module. The whole of it is compiled once per instruction set, as _core_v2, _core_v3, _core_v4: separate
// shared objects, so that no inline function compiled for a newer processor can be linked into an older one's code.
#include <nanobind/nanobind.h>

namespace nb = nanobind;

namespace dyngs {
void bind_planes(nb::module_& module);
void bind_offsets(nb::module_& module);
void bind_perceptron(nb::module_& module);
void bind_rasterizer(nb::module_& module);
void bind_shading(nb::module_& module);
void bind_skinning(nb::module_& module);
void bind_train(nb::module_& module);

namespace {

// The newest of the x86-64 levels compiled here that this processor runs. Asked of the baseline module only.
const char* best_isa() {
#if defined(__x86_64__)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("x86-64-v4")) return "v4";
  if (__builtin_cpu_supports("x86-64-v3")) return "v3";
#endif
  return "v2";
}

}  // namespace
}  // namespace dyngs

NB_MODULE(DYNGS_MODULE, module) {
  module.def("best_isa", dyngs::best_isa);
  dyngs::bind_planes(module);
  dyngs::bind_offsets(module);
  dyngs::bind_perceptron(module);
  dyngs::bind_rasterizer(module);
  dyngs::bind_shading(module);
  dyngs::bind_skinning(module);
  dyngs::bind_train(module);
}

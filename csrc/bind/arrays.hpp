// The array type of all bindings: C-contiguous NumPy or torch arrays in the memory of the module's device. That is the
// CPU, or with DYNGS_GPU a CUDA GPU; with DYNGS_EMULATED the emulated GPU uses the memory of the CPU.
// `checked` returns the pointer of an array, null for an omitted one, and throws for wrong sizes.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <optional>
#include <string>
#include <tuple>

namespace nb = nanobind;

namespace dyngs {

#if defined(DYNGS_GPU) && !defined(DYNGS_EMULATED)
using Device = nb::device::cuda;
#else
using Device = nb::device::cpu;
#endif

// On a GPU there is no float64, and bindings check sizes only: reading indices back would wait for it.
#if defined(DYNGS_GPU)
inline constexpr bool kOnGpu = true;
#else
inline constexpr bool kOnGpu = false;
#endif

template <class T, class... Config>
using Array = nb::ndarray<T, nb::c_contig, Device, Config...>;
template <class T>
using MaybeArray = std::optional<Array<T>>;
template <class T>
using Rows = Array<T, nb::ndim<2>>;

// An array parameter, which is never converted: the op would write to the copy.
inline auto array(const char* name) { return nb::arg(name).noconvert(); }

// bind.operator()<S>() for each scalar type S of this module's ops.
template <class F>
void for_each_scalar(F&& bind) {
  bind.template operator()<float>();
  if constexpr (!kOnGpu) bind.template operator()<double>();
}

template <class T>
T* checked(const Array<T>& array, int64_t count, const char* name) {
  const auto size = static_cast<int64_t>(array.size());
  if (size != count)
    throw nb::value_error(
        (name + (" has " + std::to_string(size)) + " elements, expected " + std::to_string(count)).c_str());
  return array.data();
}
// Of at least two axes, the first two of these sizes.
template <class T, class... Config>
T* checked(const Array<T, Config...>& array, int64_t rows, int64_t columns, const char* op) {
  if (static_cast<int64_t>(array.shape(0)) != rows || static_cast<int64_t>(array.shape(1)) != columns)
    throw nb::value_error((op + std::string(": arrays of different sizes")).c_str());
  return array.data();
}
template <class A, class... Sizes>
auto checked(const std::optional<A>& array, Sizes... sizes) -> decltype(array->data()) {
  return array ? checked(*array, sizes...) : nullptr;
}

// The bindings of all ops.
void bind_fields(nb::module_& module);
void bind_nodes(nb::module_& module);
void bind_offsets(nb::module_& module);
void bind_perceptron(nb::module_& module);
void bind_planes(nb::module_& module);
void bind_posing(nb::module_& module);
void bind_rasterizer(nb::module_& module);
void bind_shading(nb::module_& module);
void bind_skinning(nb::module_& module);
void bind_slicing(nb::module_& module);
void bind_train(nb::module_& module);
void bind_triangles(nb::module_& module);
inline void bind_ops(nb::module_& module) {
  for (const auto bind : {bind_fields, bind_nodes, bind_offsets, bind_perceptron, bind_planes, bind_posing,
                          bind_rasterizer, bind_shading, bind_skinning, bind_slicing, bind_train, bind_triangles})
    bind(module);
}

}  // namespace dyngs

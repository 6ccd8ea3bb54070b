// The array type of all bindings: NumPy and torch arrays in CPU memory, C-contiguous.
#pragma once

#include <nanobind/ndarray.h>

namespace dyngs {

template <class T, class... Config>
using Array = nanobind::ndarray<T, nanobind::c_contig, nanobind::device::cpu, Config...>;

}  // namespace dyngs

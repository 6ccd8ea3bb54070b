// What all bindings take: NumPy and torch arrays in memory of the CPU, row by row without gaps.
#pragma once

#include <nanobind/ndarray.h>

namespace dyngs {

template <class T, class... Config>
using Array = nanobind::ndarray<T, nanobind::c_contig, nanobind::device::cpu, Config...>;

}  // namespace dyngs

// The array type of all bindings: C-contiguous arrays of NumPy and torch, in the memory of the device whose module this is:
// the CPU's, or with DYNGS_CARD that of a CUDA card. With DYNGS_EMULATED the card's memory is the CPU's, too.
#pragma once

#include <nanobind/ndarray.h>

namespace dyngs {

#if defined(DYNGS_CARD) && !defined(DYNGS_EMULATED)
using Device = nanobind::device::cuda;
#else
using Device = nanobind::device::cpu;
#endif

// Whether the bindings may read what arrays hold. On a card they check sizes only: reading indices back would wait for it.
#if defined(DYNGS_CARD)
inline constexpr bool kReadable = false;
#else
inline constexpr bool kReadable = true;
#endif

template <class T, class... Config>
using Array = nanobind::ndarray<T, nanobind::c_contig, Device, Config...>;

}  // namespace dyngs

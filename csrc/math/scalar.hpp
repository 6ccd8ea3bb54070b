// The functions in which the formulas of this folder are written, for float and double. A formula is a template over a
// real number R; vector types with the same functions can stand in for it (cpu/simd.hpp has those of the CPU). Nothing
// here allocates or needs more of the standard library than <cmath>, so that CUDA's compiler takes it for both sides.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <type_traits>
#include <utility>

// DYNGS_INLINE is for the formulas of inner loops, where a call would cost more than they do.
#if defined(__CUDACC__)
#define DYNGS_HD __host__ __device__
#define DYNGS_INLINE __host__ __device__ __forceinline__
#else
#define DYNGS_HD
#define DYNGS_INLINE inline __attribute__((always_inline))
#endif

namespace dyngs {

// The element type of R: R itself for a number.
template <class R>
struct ScalarOf {
  using type = R;
};
template <class R>
using Scalar = typename ScalarOf<R>::type;

// The type of a comparison of two R: bool for numbers.
template <class R>
using MaskOf = decltype(std::declval<R>() < std::declval<R>());

// Variables, because a GPU cannot call functions of the standard library.
template <class S>
inline constexpr S kLargest = std::numeric_limits<S>::max();
template <class S>
inline constexpr S kNaN = std::numeric_limits<S>::quiet_NaN();
template <class S>
inline constexpr S kEpsilon = std::numeric_limits<S>::epsilon();

// True if a comparison holds in any lane. A scalar has one lane.
DYNGS_INLINE bool any(bool condition) { return condition; }

DYNGS_INLINE float select(bool condition, float a, float b) { return condition ? a : b; }
DYNGS_INLINE double select(bool condition, double a, double b) { return condition ? a : b; }
DYNGS_INLINE int32_t select(bool condition, int32_t a, int32_t b) { return condition ? a : b; }
DYNGS_INLINE int64_t select(bool condition, int64_t a, int64_t b) { return condition ? a : b; }

DYNGS_INLINE float sqrt(float x) { return std::sqrt(x); }
DYNGS_INLINE double sqrt(double x) { return std::sqrt(x); }
DYNGS_INLINE float log(float x) { return std::log(x); }
DYNGS_INLINE double log(double x) { return std::log(x); }
DYNGS_INLINE float log2(float x) { return std::log2(x); }
DYNGS_INLINE double log2(double x) { return std::log2(x); }
DYNGS_INLINE float exp2(float x) { return std::exp2(x); }
DYNGS_INLINE double exp2(double x) { return std::exp2(x); }
DYNGS_INLINE float cos(float x) { return std::cos(x); }
DYNGS_INLINE double cos(double x) { return std::cos(x); }
DYNGS_INLINE float sin(float x) { return std::sin(x); }
DYNGS_INLINE double sin(double x) { return std::sin(x); }
DYNGS_INLINE float ceil(float x) { return std::ceil(x); }
DYNGS_INLINE double ceil(double x) { return std::ceil(x); }
DYNGS_INLINE float trunc(float x) { return std::trunc(x); }
DYNGS_INLINE double trunc(double x) { return std::trunc(x); }

// The second argument where the comparison is false, as with NaN.
template <class R>
DYNGS_INLINE R min(R a, R b) {
  return select(a < b, a, b);
}
template <class R>
DYNGS_INLINE R max(R a, R b) {
  return select(a > b, a, b);
}
template <class R>
DYNGS_INLINE R clamp(R x, R lo, R hi) {
  return min(max(x, lo), hi);
}
template <class R>
DYNGS_INLINE R abs(R a) {
  return max(a, -a);
}

// a0 b0 + a1 b1 + a2 b2. The products are named, because with overloaded operators their order, and so which of them becomes
// a fused multiply-add, would be up to the compiler.
template <class A, class B>
DYNGS_INLINE A dot3(const A& a0, const B& b0, const A& a1, const B& b1, const A& a2, const B& b2) {
  const A first = a0 * b0, second = a1 * b1;
  return first + second + a2 * b2;
}

// Conversion to R, exact for the constants in the formulas.
template <class R>
DYNGS_INLINE R real(double value) {
  return R(static_cast<Scalar<R>>(value));
}

}  // namespace dyngs

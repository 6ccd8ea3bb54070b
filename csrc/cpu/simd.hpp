// A vector of kCount numbers over GCC/Clang vector extensions, on any instruction set, with the functions of
// math/scalar.hpp: the formulas of math/ run on many Gaussians, pixels or channels at a time.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

#include "math/scalar.hpp"

namespace dyngs {

inline constexpr int kLanes = 16;  // of a Packet

#if defined(__AVX512F__)
inline constexpr int kRegisterBytes = 64;
#elif defined(__AVX__)
inline constexpr int kRegisterBytes = 32;
#else
inline constexpr int kRegisterBytes = 16;
#endif

template <class S, int kCount>
inline constexpr bool kInOneRegister = kCount * sizeof(S) <= kRegisterBytes;

// Outside of Simd, because GCC 12 forgets the attribute while it looks at a template's own constructors.
template <class S, int kCount>
struct VectorOf {
  typedef S Type __attribute__((vector_size(kCount * sizeof(S))));
};

// More numbers than a register holds are two halves: GCC lowers comparisons of a vector type that is wider than a register to
// scalar code, which took eight times as long with AVX2.
template <class S, int kCount>
struct Simd {
  using Half = Simd<S, kCount / 2>;
  static constexpr int kSize = kCount;
  Half lo, hi;

  Simd() = default;
  DYNGS_INLINE Simd(Half a, Half b) : lo(a), hi(b) {}
  DYNGS_INLINE Simd(S x) : lo(x), hi(x) {}

  S& operator[](int i) { return reinterpret_cast<S*>(this)[i]; }
  S operator[](int i) const { return reinterpret_cast<const S*>(this)[i]; }

  DYNGS_INLINE static Simd load(const S* p) { return {Half::load(p), Half::load(p + kCount / 2)}; }
  DYNGS_INLINE void store(S* p) const { lo.store(p), hi.store(p + kCount / 2); }

  DYNGS_INLINE friend Simd operator+(Simd a, Simd b) { return {a.lo + b.lo, a.hi + b.hi}; }
  DYNGS_INLINE friend Simd operator-(Simd a, Simd b) { return {a.lo - b.lo, a.hi - b.hi}; }
  DYNGS_INLINE friend Simd operator*(Simd a, Simd b) { return {a.lo * b.lo, a.hi * b.hi}; }
  DYNGS_INLINE friend Simd operator/(Simd a, Simd b) { return {a.lo / b.lo, a.hi / b.hi}; }
  DYNGS_INLINE friend Simd operator-(Simd a) { return {-a.lo, -a.hi}; }
  DYNGS_INLINE Simd& operator+=(Simd b) { return *this = *this + b; }
  DYNGS_INLINE Simd& operator-=(Simd b) { return *this = *this - b; }
  DYNGS_INLINE Simd& operator*=(Simd b) { return *this = *this * b; }
};

template <class S, int kCount>
  requires kInOneRegister<S, kCount>
struct Simd<S, kCount> {  // with the alignment of its vector
  using Vec = typename VectorOf<S, kCount>::Type;
  using Int = std::conditional_t<sizeof(S) == 4, int32_t, int64_t>;
  using IntVec = typename VectorOf<Int, kCount>::Type;
  static constexpr int kSize = kCount;
  Vec v;

  Simd() = default;
  DYNGS_INLINE Simd(Vec x) : v(x) {}
  DYNGS_INLINE Simd(S x) : v(x - Vec{}) {}  // x - {} broadcasts x

  S& operator[](int i) { return reinterpret_cast<S*>(this)[i]; }
  S operator[](int i) const { return reinterpret_cast<const S*>(this)[i]; }

  DYNGS_INLINE static Simd load(const S* p) {
    Simd r;
    std::memcpy(&r.v, p, sizeof(Vec));
    return r;
  }
  DYNGS_INLINE void store(S* p) const { std::memcpy(p, &v, sizeof(Vec)); }

  DYNGS_INLINE friend Simd operator+(Simd a, Simd b) { return a.v + b.v; }
  DYNGS_INLINE friend Simd operator-(Simd a, Simd b) { return a.v - b.v; }
  DYNGS_INLINE friend Simd operator*(Simd a, Simd b) { return a.v * b.v; }
  DYNGS_INLINE friend Simd operator/(Simd a, Simd b) { return a.v / b.v; }
  DYNGS_INLINE friend Simd operator-(Simd a) { return -a.v; }
  DYNGS_INLINE Simd& operator+=(Simd b) { return *this = *this + b; }
  DYNGS_INLINE Simd& operator-=(Simd b) { return *this = *this - b; }
  DYNGS_INLINE Simd& operator*=(Simd b) { return *this = *this * b; }
};

// Sixteen Gaussians, or the pixels of a 4x4 block.
template <class S>
using Packet = Simd<S, kLanes>;

// A vector that fills one register. Packets fill two or four on older processors, which spills registers in kernels with
// many live values.
template <class S>
using Native = Simd<S, kRegisterBytes / static_cast<int>(sizeof(S))>;

template <class S>
inline Native<S> load_native(const S* from) {
  return Native<S>::load(from);
}
template <class S, int kCount>
inline void store(S* to, Simd<S, kCount> x) {
  x.store(to);
}

template <class S, int kCount>
struct ScalarOf<Simd<S, kCount>> {
  using type = S;
};

// Result of comparing two vectors: all bits set where true.
template <class S, int kCount>
struct Mask {
  using Half = Mask<S, kCount / 2>;
  Half lo, hi;
  DYNGS_INLINE friend Mask operator&(Mask a, Mask b) { return {a.lo & b.lo, a.hi & b.hi}; }
  DYNGS_INLINE friend Mask operator|(Mask a, Mask b) { return {a.lo | b.lo, a.hi | b.hi}; }
  DYNGS_INLINE friend Mask operator!(Mask a) { return {!a.lo, !a.hi}; }
};
template <class S, int kCount>
  requires kInOneRegister<S, kCount>
struct Mask<S, kCount> {
  typename Simd<S, kCount>::IntVec bits;
  DYNGS_INLINE friend Mask operator&(Mask a, Mask b) { return {a.bits & b.bits}; }
  DYNGS_INLINE friend Mask operator|(Mask a, Mask b) { return {a.bits | b.bits}; }
  DYNGS_INLINE friend Mask operator!(Mask a) { return {~a.bits}; }
};
template <class S>
using PacketMask = Mask<S, kLanes>;

#define DYNGS_COMPARE(op)                                                          \
  template <class S, int kCount>                                                   \
  DYNGS_INLINE Mask<S, kCount> operator op(Simd<S, kCount> a, Simd<S, kCount> b) { \
    if constexpr (kInOneRegister<S, kCount>)                                       \
      return {a.v op b.v};                                                         \
    else                                                                           \
      return {a.lo op b.lo, a.hi op b.hi};                                         \
  }
DYNGS_COMPARE(<)
DYNGS_COMPARE(<=)
DYNGS_COMPARE(>)
DYNGS_COMPARE(>=)
DYNGS_COMPARE(==)
#undef DYNGS_COMPARE
template <class S, int kCount>
DYNGS_INLINE Simd<S, kCount> select(Mask<S, kCount> m, Simd<S, kCount> a, Simd<S, kCount> b) {
  if constexpr (kInOneRegister<S, kCount>)
    return m.bits ? a.v : b.v;
  else
    return {select(m.lo, a.lo, b.lo), select(m.hi, a.hi, b.hi)};
}

// Bit i: lane i.
template <class S, int kCount>
DYNGS_INLINE uint32_t to_bits(Mask<S, kCount> m) {
  if constexpr (!kInOneRegister<S, kCount>) {
    return to_bits(m.lo) | to_bits(m.hi) << (kCount / 2);
#if defined(__AVX__)
  } else if constexpr (sizeof m == 32 && sizeof(S) == 4) {
    return static_cast<uint32_t>(_mm256_movemask_ps((__m256)m.bits));
#endif
#if defined(__SSE2__)
  } else if constexpr (sizeof m == 16 && sizeof(S) == 4) {
    return static_cast<uint32_t>(_mm_movemask_ps((__m128)m.bits));
#endif
  } else {
    uint32_t bits = 0;
    for (int i = 0; i < kCount; ++i) bits |= (m.bits[i] != 0 ? 1u : 0u) << i;
    return bits;
  }
}

#if defined(__AVX512F__) && defined(__AVX512DQ__)
// Comparisons go to mask registers here; GCC's lowering of vector comparisons would keep them in data registers.
template <>
struct Mask<float, kLanes> {
  __mmask16 bits;
  friend Mask operator&(Mask a, Mask b) { return {static_cast<__mmask16>(a.bits & b.bits)}; }
  friend Mask operator|(Mask a, Mask b) { return {static_cast<__mmask16>(a.bits | b.bits)}; }
  friend Mask operator!(Mask a) { return {static_cast<__mmask16>(~a.bits)}; }
};
#define DYNGS_COMPARE(op, code)                                            \
  inline PacketMask<float> operator op(Packet<float> a, Packet<float> b) { \
    return {_mm512_cmp_ps_mask((__m512)a.v, (__m512)b.v, code)};           \
  }
DYNGS_COMPARE(<, _CMP_LT_OQ)
DYNGS_COMPARE(<=, _CMP_LE_OQ)
DYNGS_COMPARE(>, _CMP_GT_OQ)
DYNGS_COMPARE(>=, _CMP_GE_OQ)
DYNGS_COMPARE(==, _CMP_EQ_OQ)
#undef DYNGS_COMPARE
inline Packet<float> select(PacketMask<float> m, Packet<float> a, Packet<float> b) {
  return (Packet<float>::Vec)_mm512_mask_blend_ps(m.bits, (__m512)b.v, (__m512)a.v);
}
inline uint32_t to_bits(PacketMask<float> m) { return m.bits; }
#endif

template <class S, int kCount>
DYNGS_INLINE bool any(Mask<S, kCount> m) {
  if constexpr (!kInOneRegister<S, kCount>)
    return any(m.lo | m.hi);
  else
    return to_bits(m) != 0;
}

#if defined(__AVX512F__)
// In one instruction, NaN included: b where the comparison is false.
inline Packet<float> min(Packet<float> a, Packet<float> b) {
  return (Packet<float>::Vec)_mm512_min_ps((__m512)a.v, (__m512)b.v);
}
inline Packet<float> max(Packet<float> a, Packet<float> b) {
  return (Packet<float>::Vec)_mm512_max_ps((__m512)a.v, (__m512)b.v);
}
#endif

template <class S, int kCount>
DYNGS_INLINE Simd<S, kCount> sqrt(Simd<S, kCount> x) {
  if constexpr (!kInOneRegister<S, kCount>) return {sqrt(x.lo), sqrt(x.hi)};
#if defined(__AVX512F__)
  else if constexpr (sizeof(x) == 64 && sizeof(S) == 4)
    return (typename Simd<S, kCount>::Vec)_mm512_sqrt_ps((__m512)x.v);
#endif
#if defined(__AVX__)
  else if constexpr (sizeof(x) == 32 && sizeof(S) == 4)
    return (typename Simd<S, kCount>::Vec)_mm256_sqrt_ps((__m256)x.v);
#endif
#if defined(__SSE2__)
  else if constexpr (sizeof(x) == 16 && sizeof(S) == 4)
    return (typename Simd<S, kCount>::Vec)_mm_sqrt_ps((__m128)x.v);
#endif
  else {
    Simd<S, kCount> r;
    for (int i = 0; i < kCount; ++i) r[i] = std::sqrt(x[i]);
    return r;
  }
}

template <class S, int kCount>
inline Simd<S, kCount> log(Simd<S, kCount> x) {
  Simd<S, kCount> r;
  for (int i = 0; i < kCount; ++i) r[i] = std::log(x[i]);
  return r;
}

template <class S, int kCount>
inline Simd<S, kCount> ceil(Simd<S, kCount> x) {
  Simd<S, kCount> r;
  for (int i = 0; i < kCount; ++i) r[i] = std::ceil(x[i]);
  return r;
}

// For |x| below 2^31.
template <class S, int kCount>
DYNGS_INLINE Simd<S, kCount> trunc(Simd<S, kCount> x) {
  using V = Simd<S, kCount>;
  if constexpr (!kInOneRegister<S, kCount>)
    return {trunc(x.lo), trunc(x.hi)};
  else
    return __builtin_convertvector(__builtin_convertvector(x.v, typename V::IntVec), typename V::Vec);
}

template <int kCount>
inline Simd<double, kCount> exp2(Simd<double, kCount> x) {
  Simd<double, kCount> r;
  for (int i = 0; i < kCount; ++i) r[i] = std::exp2(x[i]);
  return r;
}

// 2^x for x <= 0, relative error below 2.5e-7; results under 2^-126 are flushed to about 2^-126.
template <int kCount>
DYNGS_INLINE Simd<float, kCount> exp2(Simd<float, kCount> x) {
  using P = Simd<float, kCount>;
  if constexpr (!kInOneRegister<float, kCount>) {
    return {exp2(x.lo), exp2(x.hi)};
  } else {
    x = max(x, P(-126.0f));
    const P shifted = x + P(12582912.0f);  // 1.5 * 2^23: rounds x to an integer, which lands in the low mantissa bits
    const P f = x - (shifted - P(12582912.0f));
    P p = P(1.32764713e-3f);  // minimax fit of 2^f on [-0.5, 0.5], relative error 7.5e-8
    p = p * f + P(9.67554133e-3f);
    p = p * f + P(5.55071328e-2f);
    p = p * f + P(2.40221197e-1f);
    p = p * f + P(6.93146967e-1f);
    p = p * f + P(1.00000007f);
    typename P::IntVec n, bits;
    std::memcpy(&n, &shifted.v, sizeof n);
    std::memcpy(&bits, &p.v, sizeof bits);
    bits += n << 23;  // the float 1.5*2^23 has zeros below, so the shift leaves just the integer in the exponent field
    std::memcpy(&p.v, &bits, sizeof bits);
    return p;
  }
}

template <class S, int kCount>
inline S horizontal_sum(Simd<S, kCount> x) {
  S sum = 0;
  for (int i = 0; i < kCount; ++i) sum += x[i];
  return sum;
}

}  // namespace dyngs

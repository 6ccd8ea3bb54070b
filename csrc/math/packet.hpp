// Sixteen lanes of one scalar type, over GCC/Clang vector extensions. The formulas in math/ are templates over a
// "real" type; Packet<float> and Packet<double> make them run on 16 Gaussians or 16 pixels at a time, on any ISA.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <utility>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace dyngs {

inline constexpr int kLanes = 16;

template <class S>
struct LaneTypes;
template <>
struct LaneTypes<float> {
  typedef float Vec __attribute__((vector_size(64)));
  typedef int32_t Int;
  typedef int32_t IntVec __attribute__((vector_size(64)));
};
template <>
struct LaneTypes<double> {
  typedef double Vec __attribute__((vector_size(128)));
  typedef int64_t Int;
  typedef int64_t IntVec __attribute__((vector_size(128)));
};

// Result of comparing two packets: all bits set where true.
template <class S>
struct Mask {
  typename LaneTypes<S>::IntVec bits;
  friend Mask operator&(Mask a, Mask b) { return {a.bits & b.bits}; }
  friend Mask operator|(Mask a, Mask b) { return {a.bits | b.bits}; }
  friend Mask operator!(Mask a) { return {~a.bits}; }
};

template <class S>
struct Packet {  // aligned as its vector is
  using Vec = typename LaneTypes<S>::Vec;
  Vec v;

  Packet() = default;
  Packet(Vec x) : v(x) {}
  Packet(S x) : v(x - Vec{}) {}  // x - {} broadcasts x

  S& operator[](int i) { return reinterpret_cast<S*>(&v)[i]; }
  S operator[](int i) const { return reinterpret_cast<const S*>(&v)[i]; }

  static Packet load(const S* p) {
    Packet r;
    std::memcpy(&r.v, p, sizeof(Vec));
    return r;
  }
  void store(S* p) const { std::memcpy(p, &v, sizeof(Vec)); }

  friend Packet operator+(Packet a, Packet b) { return a.v + b.v; }
  friend Packet operator-(Packet a, Packet b) { return a.v - b.v; }
  friend Packet operator*(Packet a, Packet b) { return a.v * b.v; }
  friend Packet operator/(Packet a, Packet b) { return a.v / b.v; }
  friend Packet operator-(Packet a) { return -a.v; }
  Packet& operator+=(Packet b) { v += b.v; return *this; }
  Packet& operator-=(Packet b) { v -= b.v; return *this; }
  Packet& operator*=(Packet b) { v *= b.v; return *this; }
};

#if defined(__AVX512F__) && defined(__AVX512DQ__)
// Comparisons go to mask registers here; GCC's lowering of vector comparisons would keep them in data registers.
template <>
struct Mask<float> {
  __mmask16 bits;
  friend Mask operator&(Mask a, Mask b) { return {static_cast<__mmask16>(a.bits & b.bits)}; }
  friend Mask operator|(Mask a, Mask b) { return {static_cast<__mmask16>(a.bits | b.bits)}; }
  friend Mask operator!(Mask a) { return {static_cast<__mmask16>(~a.bits)}; }
};
#define DYNGS_COMPARE(op, code)                                                     \
  inline Mask<float> operator op(Packet<float> a, Packet<float> b) {                \
    return {_mm512_cmp_ps_mask((__m512)a.v, (__m512)b.v, code)};                    \
  }                                                                                 \
  inline Mask<double> operator op(Packet<double> a, Packet<double> b) { return {a.v op b.v}; }
DYNGS_COMPARE(<, _CMP_LT_OQ)
DYNGS_COMPARE(<=, _CMP_LE_OQ)
DYNGS_COMPARE(>, _CMP_GT_OQ)
DYNGS_COMPARE(>=, _CMP_GE_OQ)
DYNGS_COMPARE(==, _CMP_EQ_OQ)
#undef DYNGS_COMPARE
inline Packet<float> select(Mask<float> m, Packet<float> a, Packet<float> b) {
  return (Packet<float>::Vec)_mm512_mask_blend_ps(m.bits, (__m512)b.v, (__m512)a.v);
}
inline Packet<double> select(Mask<double> m, Packet<double> a, Packet<double> b) { return m.bits ? a.v : b.v; }
inline bool any(Mask<float> m) { return m.bits != 0; }
inline uint32_t to_bits(Mask<float> m) { return m.bits; }
#else
template <class S>
Mask<S> operator<(Packet<S> a, Packet<S> b) { return {a.v < b.v}; }
template <class S>
Mask<S> operator<=(Packet<S> a, Packet<S> b) { return {a.v <= b.v}; }
template <class S>
Mask<S> operator>(Packet<S> a, Packet<S> b) { return {a.v > b.v}; }
template <class S>
Mask<S> operator>=(Packet<S> a, Packet<S> b) { return {a.v >= b.v}; }
template <class S>
Mask<S> operator==(Packet<S> a, Packet<S> b) { return {a.v == b.v}; }
template <class S>
Packet<S> select(Mask<S> m, Packet<S> a, Packet<S> b) { return m.bits ? a.v : b.v; }
#if defined(__SSE2__)
inline uint32_t to_bits(Mask<float> m) {
  uint32_t bits = 0;
  for (int i = 0; i < 4; ++i) {
    __m128 part;
    std::memcpy(&part, reinterpret_cast<const char*>(&m.bits) + 16 * i, 16);
    bits |= static_cast<uint32_t>(_mm_movemask_ps(part)) << (4 * i);
  }
  return bits;
}
#else
inline uint32_t to_bits(Mask<float> m) {
  uint32_t bits = 0;
  for (int i = 0; i < kLanes; ++i) bits |= (m.bits[i] != 0 ? 1u : 0u) << i;
  return bits;
}
#endif
inline bool any(Mask<float> m) { return to_bits(m) != 0; }
#endif

inline uint32_t to_bits(Mask<double> m) {
  uint32_t bits = 0;
  for (int i = 0; i < kLanes; ++i) bits |= (m.bits[i] != 0 ? 1u : 0u) << i;
  return bits;
}
inline bool any(Mask<double> m) { return to_bits(m) != 0; }

// The same vocabulary for plain scalars, so that one formula serves both.
template <class S>
using MaskOf = decltype(std::declval<S>() < std::declval<S>());
inline float select(bool m, float a, float b) { return m ? a : b; }
inline double select(bool m, double a, double b) { return m ? a : b; }

template <class R>
R min_of(R a, R b) { return select(a < b, a, b); }
template <class R>
R max_of(R a, R b) { return select(a > b, a, b); }
#if defined(__AVX512F__)
// The same in one instruction, NaN included: b where the comparison is false.
inline Packet<float> min_of(Packet<float> a, Packet<float> b) {
  return (Packet<float>::Vec)_mm512_min_ps((__m512)a.v, (__m512)b.v);
}
inline Packet<float> max_of(Packet<float> a, Packet<float> b) {
  return (Packet<float>::Vec)_mm512_max_ps((__m512)a.v, (__m512)b.v);
}
#endif
template <class R>
R abs_of(R a) { return max_of(a, -a); }

inline float sqrt_of(float x) { return std::sqrt(x); }
inline double sqrt_of(double x) { return std::sqrt(x); }
template <class S>
Packet<S> sqrt_of(Packet<S> x) {
#if defined(__AVX512F__)
  if constexpr (sizeof(S) == 4) return (typename Packet<S>::Vec)_mm512_sqrt_ps((__m512)x.v);
#endif
  Packet<S> r;
  for (int i = 0; i < kLanes; ++i) r[i] = std::sqrt(x[i]);
  return r;
}

inline float log_of(float x) { return std::log(x); }
inline double log_of(double x) { return std::log(x); }
template <class S>
Packet<S> log_of(Packet<S> x) {
  Packet<S> r;
  for (int i = 0; i < kLanes; ++i) r[i] = std::log(x[i]);
  return r;
}

inline Packet<double> exp2_of(Packet<double> x) {
  Packet<double> r;
  for (int i = 0; i < kLanes; ++i) r[i] = std::exp2(x[i]);
  return r;
}

// 2^x for x <= 0, relative error below 2.5e-7; results under 2^-126 are flushed to about 2^-126.
inline Packet<float> exp2_of(Packet<float> x) {
  using P = Packet<float>;
  x = max_of(x, P(-126.0f));
  const P shifted = x + P(12582912.0f);  // 1.5 * 2^23: rounds x to an integer, which lands in the low mantissa bits
  const P f = x - (shifted - P(12582912.0f));
  P p = P(1.32764713e-3f);  // minimax fit of 2^f on [-0.5, 0.5], relative error 7.5e-8
  p = p * f + P(9.67554133e-3f);
  p = p * f + P(5.55071328e-2f);
  p = p * f + P(2.40221197e-1f);
  p = p * f + P(6.93146967e-1f);
  p = p * f + P(1.00000007f);
  typedef LaneTypes<float>::IntVec IntVec;
  IntVec n, bits;
  std::memcpy(&n, &shifted.v, sizeof n);
  std::memcpy(&bits, &p.v, sizeof bits);
  bits += n << 23;  // the float 1.5*2^23 has zeros below, so the shift leaves just the integer in the exponent field
  std::memcpy(&p.v, &bits, sizeof bits);
  return p;
}

// Towards zero; for |x| below 2^31.
template <class S>
Packet<S> truncated(Packet<S> x) {
  using Int = typename LaneTypes<S>::IntVec;
  return __builtin_convertvector(__builtin_convertvector(x.v, Int), typename Packet<S>::Vec);
}

template <class S>
S horizontal_sum(Packet<S> x) {
  S sum = 0;
  for (int i = 0; i < kLanes; ++i) sum += x[i];
  return sum;
}

template <class R>
struct ScalarOf { using type = R; };
template <class S>
struct ScalarOf<Packet<S>> { using type = S; };

}  // namespace dyngs

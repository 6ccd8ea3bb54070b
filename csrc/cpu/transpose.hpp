// In-place transpose of a 16x16 matrix of rows held in packets. It turns "16 pixels of one Gaussian" into "one pixel of 16
// Gaussians", so that sums over pixels need no horizontal adds.
#pragma once

#include "cpu/simd.hpp"

namespace dyngs {

template <class S>
void transpose16(Packet<S> (&rows)[kLanes]) {
  Packet<S> out[kLanes];
  for (int r = 0; r < kLanes; ++r)
    for (int c = 0; c < kLanes; ++c) out[c][r] = rows[r][c];
  for (int r = 0; r < kLanes; ++r) rows[r] = out[r];
}

#if defined(__AVX512F__)
inline void transpose16(Packet<float> (&rows)[kLanes]) {
  __m512 a[16], b[16];
  for (int i = 0; i < 16; i += 4) {  // 4x4 blocks within the four 128-bit parts
    const __m512 r0 = (__m512)rows[i].v, r1 = (__m512)rows[i + 1].v;
    const __m512 r2 = (__m512)rows[i + 2].v, r3 = (__m512)rows[i + 3].v;
    const __m512d lo01 = _mm512_castps_pd(_mm512_unpacklo_ps(r0, r1)),
                  hi01 = _mm512_castps_pd(_mm512_unpackhi_ps(r0, r1));
    const __m512d lo23 = _mm512_castps_pd(_mm512_unpacklo_ps(r2, r3)),
                  hi23 = _mm512_castps_pd(_mm512_unpackhi_ps(r2, r3));
    a[i] = _mm512_castpd_ps(_mm512_unpacklo_pd(lo01, lo23));
    a[i + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(lo01, lo23));
    a[i + 2] = _mm512_castpd_ps(_mm512_unpacklo_pd(hi01, hi23));
    a[i + 3] = _mm512_castpd_ps(_mm512_unpackhi_pd(hi01, hi23));
  }
  for (int c = 0; c < 4; ++c) {  // then a 4x4 transpose of the parts
    const __m512 p = _mm512_shuffle_f32x4(a[c], a[4 + c], 0x44), q = _mm512_shuffle_f32x4(a[8 + c], a[12 + c], 0x44);
    const __m512 r = _mm512_shuffle_f32x4(a[c], a[4 + c], 0xee), s = _mm512_shuffle_f32x4(a[8 + c], a[12 + c], 0xee);
    b[c] = _mm512_shuffle_f32x4(p, q, 0x88);
    b[4 + c] = _mm512_shuffle_f32x4(p, q, 0xdd);
    b[8 + c] = _mm512_shuffle_f32x4(r, s, 0x88);
    b[12 + c] = _mm512_shuffle_f32x4(r, s, 0xdd);
  }
  for (int i = 0; i < 16; ++i) rows[i] = (Packet<float>::Vec)b[i];
}
#elif defined(__SSE2__)
inline void transpose16(Packet<float> (&rows)[kLanes]) {
  Packet<float> out[kLanes];
  for (int r = 0; r < kLanes; r += 4)
    for (int c = 0; c < kLanes; c += 4) {
      __m128 part[4];
      for (int i = 0; i < 4; ++i) part[i] = _mm_loadu_ps(reinterpret_cast<const float*>(&rows[r + i]) + c);
      _MM_TRANSPOSE4_PS(part[0], part[1], part[2], part[3]);
      for (int i = 0; i < 4; ++i) _mm_storeu_ps(reinterpret_cast<float*>(&out[c + i]) + r, part[i]);
    }
  for (int r = 0; r < kLanes; ++r) rows[r] = out[r];
}
#endif

}  // namespace dyngs

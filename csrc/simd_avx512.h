// Sixteen floats are one AVX-512 register and a predicate is one mask register: what simd.h does in general,
// in single instructions. Included by simd.h.
#pragma once

namespace vlgs::VLGS_ISA_NS {

template <>
struct Mask<float> {
  __mmask16 bits;
};
VLGS_INLINE Mask<float> operator<=(const Pack<float> &a, const Pack<float> &b) {
  return {_mm512_cmp_ps_mask((__m512)a.part[0], (__m512)b.part[0], _CMP_LE_OQ)};
}
VLGS_INLINE Mask<float> operator<(const Pack<float> &a, const Pack<float> &b) {
  return {_mm512_cmp_ps_mask((__m512)a.part[0], (__m512)b.part[0], _CMP_LT_OQ)};
}
VLGS_INLINE Mask<float> operator&(Mask<float> a, const Mask<float> &b) {
  return {(__mmask16)(a.bits & b.bits)};
}
VLGS_INLINE Mask<float> operator|(Mask<float> a, const Mask<float> &b) {
  return {(__mmask16)(a.bits | b.bits)};
}
VLGS_INLINE Mask<float> operator~(Mask<float> a) { return {(__mmask16)~a.bits}; }
VLGS_INLINE bool any(const Mask<float> &m) { return m.bits != 0; }
VLGS_INLINE Pack<float> select(const Mask<float> &m, Pack<float> a, const Pack<float> &b) {
  return {{(Pack<float>::Native)_mm512_mask_blend_ps(m.bits, (__m512)b.part[0], (__m512)a.part[0])}};
}
VLGS_INLINE Pack<float> min(Pack<float> a, const Pack<float> &b) {
  return {{(Pack<float>::Native)_mm512_min_ps((__m512)a.part[0], (__m512)b.part[0])}};
}

VLGS_INLINE Pack<float> exp2_of_minus(const Pack<float> &x) {
  const __m512 t = _mm512_sub_ps(_mm512_setzero_ps(), (__m512)x.part[0]);
  const __m512 n = _mm512_roundscale_ps(t, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
  const __m512 r = _mm512_sub_ps(t, n);
  // The polynomial of simd.h.
  __m512 p = _mm512_fmadd_ps(_mm512_set1_ps(0x1.5bba14p-10f), r, _mm512_set1_ps(0x1.3cea88p-7f));
  p = _mm512_fmadd_ps(p, r, _mm512_set1_ps(0x1.c6b752p-5f));
  p = _mm512_fmadd_ps(p, r, _mm512_set1_ps(0x1.ebf9bcp-3f));
  p = _mm512_fmadd_ps(p, r, _mm512_set1_ps(0x1.62e42ap-1f));
  p = _mm512_fmadd_ps(p, r, _mm512_set1_ps(1.0f));
  return {{(Pack<float>::Native)_mm512_scalef_ps(p, n)}};
}

// Relative error below 2^-23: 14 bits of the estimate, doubled by one Newton step.
VLGS_INLINE Pack<float> reciprocal(Pack<float> x) {
  const __m512 d = (__m512)x.part[0];
  const __m512 r = _mm512_rcp14_ps(d);
  return {{(Pack<float>::Native)_mm512_fmadd_ps(r, _mm512_fnmadd_ps(d, r, _mm512_set1_ps(1.0f)), r)}};
}

// Four levels of "interleave two, add" bring sixteen sums into the sixteen lanes of one register.
VLGS_INLINE void sum_lanes(const Pack<float> *packs, float *sums) {
  __m512 quads[4];  // lane 4 k + j: part k of the sum of packs[4 i + j]
  for (int i = 0; i < 4; ++i) {
    const __m512 a = (__m512)packs[4 * i].part[0], b = (__m512)packs[4 * i + 1].part[0];
    const __m512 c = (__m512)packs[4 * i + 2].part[0], d = (__m512)packs[4 * i + 3].part[0];
    const __m512d ab = (__m512d)_mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b));
    const __m512d cd = (__m512d)_mm512_add_ps(_mm512_unpacklo_ps(c, d), _mm512_unpackhi_ps(c, d));
    quads[i] = _mm512_add_ps((__m512)_mm512_unpacklo_pd(ab, cd), (__m512)_mm512_unpackhi_pd(ab, cd));
  }
  const __m512 low = _mm512_add_ps(_mm512_shuffle_f32x4(quads[0], quads[1], 0x88),
                                   _mm512_shuffle_f32x4(quads[0], quads[1], 0xdd));
  const __m512 high = _mm512_add_ps(_mm512_shuffle_f32x4(quads[2], quads[3], 0x88),
                                    _mm512_shuffle_f32x4(quads[2], quads[3], 0xdd));
  _mm512_storeu_ps(
      sums, _mm512_add_ps(_mm512_shuffle_f32x4(low, high, 0x88), _mm512_shuffle_f32x4(low, high, 0xdd)));
}

}  // namespace vlgs::VLGS_ISA_NS

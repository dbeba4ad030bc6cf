// Sixteen lanes of float or double: one 4x4 block of pixels. Everything lives in the namespace of one
// instruction set, so that the linker can never give code compiled for one to another.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__AVX2__)  // elsewhere nothing of it is used, and reading it takes a quarter of a second per file
#include <immintrin.h>
#endif

namespace vlgs::VLGS_ISA_NS {

constexpr int kLanes = 16;

// Packs that travel through a call travel through memory, which is slow to run and quick to compile.
// Sanitizers look on there: what they add to code that is inlined everywhere takes the compiler minutes.
#if defined(__SANITIZE_ADDRESS__) || defined(VLGS_CALLS)
#define VLGS_INLINE inline
#else
#define VLGS_INLINE inline __attribute__((always_inline))
#endif

#if defined(__AVX512F__)
constexpr int kNativeBytes = 64;
#elif defined(__AVX2__)
constexpr int kNativeBytes = 32;
#else
constexpr int kNativeBytes = 16;
#endif

template <class T>
struct NativeOf;
template <>
struct NativeOf<float> {
  typedef float Type __attribute__((vector_size(kNativeBytes)));
  typedef int32_t Int __attribute__((vector_size(kNativeBytes)));
};
template <>
struct NativeOf<double> {
  typedef double Type __attribute__((vector_size(kNativeBytes)));
  typedef int64_t Int __attribute__((vector_size(kNativeBytes)));
};

// One rounding where the instruction set has it, two elsewhere; never left to the compiler, which may
// contract one of two equal expressions and not the other.
template <class V>
VLGS_INLINE V native_fma(V a, V b, V c) {
#if defined(__AVX512F__)
  if constexpr (sizeof(a[0]) == 4)
    return (V)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
  else
    return (V)_mm512_fmadd_pd((__m512d)a, (__m512d)b, (__m512d)c);
#elif defined(__FMA__)
  if constexpr (sizeof(a[0]) == 4)
    return (V)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
  else
    return (V)_mm256_fmadd_pd((__m256d)a, (__m256d)b, (__m256d)c);
#else
  return a * b + c;
#endif
}
template <class V>
VLGS_INLINE V native_fnma(V a, V b, V c) {
#if defined(__AVX512F__)
  if constexpr (sizeof(a[0]) == 4)
    return (V)_mm512_fnmadd_ps((__m512)a, (__m512)b, (__m512)c);
  else
    return (V)_mm512_fnmadd_pd((__m512d)a, (__m512d)b, (__m512d)c);
#elif defined(__FMA__)
  if constexpr (sizeof(a[0]) == 4)
    return (V)_mm256_fnmadd_ps((__m256)a, (__m256)b, (__m256)c);
  else
    return (V)_mm256_fnmadd_pd((__m256d)a, (__m256d)b, (__m256d)c);
#else
  return c - a * b;
#endif
}

template <class T>
struct Pack {
  using Native = typename NativeOf<T>::Type;
  static constexpr int kWidth = kNativeBytes / sizeof(T);
  static constexpr int kParts = kLanes / kWidth;
  Native part[kParts];
};

// A predicate per lane; all bits of a lane are equal.
template <class T>
struct Mask {
  using Native = typename NativeOf<T>::Int;
  Native part[Pack<T>::kParts];
};

#define VLGS_FOR_PARTS for (int i = 0; i < Pack<T>::kParts; ++i)

template <class T>
VLGS_INLINE Pack<T> splat(T x) {
  Pack<T> r;
  VLGS_FOR_PARTS r.part[i] = x - typename Pack<T>::Native{};
  return r;
}
template <class T>
VLGS_INLINE Pack<T> load(const T *from) {
  Pack<T> r;
  VLGS_FOR_PARTS std::memcpy(&r.part[i], from + i * Pack<T>::kWidth, kNativeBytes);
  return r;
}
template <class T>
VLGS_INLINE void store(T *to, const Pack<T> &a) {
  VLGS_FOR_PARTS std::memcpy(to + i * Pack<T>::kWidth, &a.part[i], kNativeBytes);
}
template <class T>
VLGS_INLINE Pack<T> operator+(Pack<T> a, const Pack<T> &b) {
  VLGS_FOR_PARTS a.part[i] += b.part[i];
  return a;
}
template <class T>
VLGS_INLINE Pack<T> operator-(Pack<T> a, const Pack<T> &b) {
  VLGS_FOR_PARTS a.part[i] -= b.part[i];
  return a;
}
template <class T>
VLGS_INLINE Pack<T> operator*(Pack<T> a, const Pack<T> &b) {
  VLGS_FOR_PARTS a.part[i] *= b.part[i];
  return a;
}
// a * b + c
template <class T>
VLGS_INLINE Pack<T> fma(const Pack<T> &a, const Pack<T> &b, Pack<T> c) {
  VLGS_FOR_PARTS c.part[i] = native_fma(a.part[i], b.part[i], c.part[i]);
  return c;
}
// c - a * b
template <class T>
VLGS_INLINE Pack<T> fnma(const Pack<T> &a, const Pack<T> &b, Pack<T> c) {
  VLGS_FOR_PARTS c.part[i] = native_fnma(a.part[i], b.part[i], c.part[i]);
  return c;
}
template <class T>
VLGS_INLINE Pack<T> min(Pack<T> a, const Pack<T> &b) {
  VLGS_FOR_PARTS a.part[i] = a.part[i] < b.part[i] ? a.part[i] : b.part[i];
  return a;
}
template <class T>
VLGS_INLINE Mask<T> operator<=(const Pack<T> &a, const Pack<T> &b) {
  Mask<T> r;
  VLGS_FOR_PARTS r.part[i] = a.part[i] <= b.part[i];
  return r;
}
template <class T>
VLGS_INLINE Mask<T> operator<(const Pack<T> &a, const Pack<T> &b) {
  Mask<T> r;
  VLGS_FOR_PARTS r.part[i] = a.part[i] < b.part[i];
  return r;
}
template <class T>
VLGS_INLINE Mask<T> operator&(Mask<T> a, const Mask<T> &b) {
  VLGS_FOR_PARTS a.part[i] &= b.part[i];
  return a;
}
template <class T>
VLGS_INLINE Mask<T> operator|(Mask<T> a, const Mask<T> &b) {
  VLGS_FOR_PARTS a.part[i] |= b.part[i];
  return a;
}
template <class T>
VLGS_INLINE Mask<T> operator~(Mask<T> a) {
  VLGS_FOR_PARTS a.part[i] = ~a.part[i];
  return a;
}
template <class T>
VLGS_INLINE Pack<T> select(const Mask<T> &m, Pack<T> a, const Pack<T> &b) {
  VLGS_FOR_PARTS a.part[i] = m.part[i] ? a.part[i] : b.part[i];
  return a;
}
template <class T>
VLGS_INLINE bool any(const Mask<T> &m) {
  typename Mask<T>::Native all = m.part[0];
  for (int i = 1; i < Pack<T>::kParts; ++i) all |= m.part[i];
#if defined(__AVX512F__)
  return _mm512_test_epi64_mask((__m512i)all, (__m512i)all) != 0;
#elif defined(__AVX2__)
  return !_mm256_testz_si256((__m256i)all, (__m256i)all);
#else
  int64_t word[2];
  std::memcpy(word, &all, sizeof word);
  return (word[0] | word[1]) != 0;
#endif
}

// 2^-x for 0 <= x <= 126, relative error below 1.7e-7 and exactly 1 at 0; other lanes come back as anything.
#if !defined(__AVX512F__)
VLGS_INLINE Pack<float> exp2_of_minus(const Pack<float> &x) {
  // Adding 1.5 * 2^23 rounds to an integer and leaves it in the low bits; as an addend of the exponent it is
  // 2^n.
  const Pack<float> magic = splat(12582912.0f);
  const Pack<float> shifted = magic - x;
  const Pack<float> r = (magic - shifted) - x;  // in [-1/2, 1/2]
  // Minimax of (2^r - 1) / r in relative error of 2^r, fitted by Lawson's iteration.
  Pack<float> p = fma(splat(0x1.5bba14p-10f), r, splat(0x1.3cea88p-7f));
  p = fma(p, r, splat(0x1.c6b752p-5f));
  p = fma(p, r, splat(0x1.ebf9bcp-3f));
  p = fma(p, r, splat(0x1.62e42ap-1f));
  p = fma(p, r, splat(1.0f));
  typedef uint32_t Bits __attribute__((vector_size(kNativeBytes)));  // may wrap round in the other lanes
  for (int i = 0; i < Pack<float>::kParts; ++i)
    p.part[i] = (Pack<float>::Native)((Bits)p.part[i] + ((Bits)shifted.part[i] << 23));
  return p;
}
#endif
VLGS_INLINE Pack<double> exp2_of_minus(const Pack<double> &x) {
  double lane[kLanes];
  store(lane, x);
  for (double &v : lane) v = __builtin_exp2(-v);
  return load(lane);
}

template <class T>
VLGS_INLINE Pack<T> reciprocal(Pack<T> x) {
  VLGS_FOR_PARTS x.part[i] = 1 / x.part[i];
  return x;
}

// sums[i] = the sum over the lanes of packs[i], in a fixed order.
template <class T>
VLGS_INLINE void sum_lanes(const Pack<T> *packs, T *sums) {
  T lane[kLanes][kLanes], quarter[kLanes][4];
  for (int i = 0; i < kLanes; ++i) store(lane[i], packs[i]);
  for (int i = 0; i < kLanes; ++i)
    for (int j = 0; j < 4; ++j)
      quarter[i][j] = (lane[i][j] + lane[i][j + 8]) + (lane[i][j + 4] + lane[i][j + 12]);
  for (int i = 0; i < kLanes; ++i)
    sums[i] = (quarter[i][0] + quarter[i][2]) + (quarter[i][1] + quarter[i][3]);
}

}  // namespace vlgs::VLGS_ISA_NS

#if defined(__AVX512F__)
#include "simd_avx512.h"
#endif

// The window of SSIM: a symmetric filter along both sides of an image.
#pragma once

#include <cstdint>

namespace vlgs {

constexpr int kTaps = 11;

// Planes [planes, height, width] to planes of the same shape, with zeros beyond the edge. Filter and
// transposed filter are the same.
template <class T>
struct Window {
  int64_t planes, height, width;
  const T *in, *taps;  // taps [kTaps]
  T *out;
};

template <class T>
void filter(const Window<T> &, int threads);

}  // namespace vlgs

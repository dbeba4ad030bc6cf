// The window of SSIM: a symmetric filter along both sides of an image, and what it is for.
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

// Structural similarity of two images [height, width, channels], one value per channel and pixel: from the
// moments of p = a + b and q = a - b (vlgs/losses.py, `ssim_map`).
template <class T>
struct Similarity {
  int64_t height, width, channels;
  const T *a, *b, *taps;
  T luminance_floor, structure_floor;  // added to both sides of the two ratios
  T *out;                              // [channels, height, width]
};

template <class T>
void filter(const Window<T> &, int threads);
template <class T>
void similarity(const Similarity<T> &, int threads);

}  // namespace vlgs

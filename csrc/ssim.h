// Structural similarity of two images, one value per pixel and channel, what 3DGS's loss sums of it, and
// gradients.
#pragma once

#include <cstdint>

namespace vlgs {

constexpr int kTaps = 11;  // of the window, along either side

// From the moments of p = a + b and q = a - b (vlgs/losses.py, `ssim_map`), with zeros beyond the edge.
template <class T>
struct Ssim {
  int64_t height, width, channels;
  const T *a, *b;  // [height, width, channels]
  const bool
      *valid;  // [height, width]; null where all count. At others both images are taken for 0 and never read.
  const T *taps;                       // [kTaps], symmetric
  T luminance_floor, structure_floor;  // added to both sides of the two ratios

  int64_t numbers() const { return width * channels; }  // of a row
};

// Sums over the pixels that count, and their number.
struct SsimSums {
  double distance, dissimilarity;  // of |a - b| and of 1 - similarity
  int64_t pixels;
};

template <class T>
struct SsimGrads {
  const T *d_map;  // [height, width, channels]: given; null where it is d_value at every pixel that counts
  T d_value, d_distance;
  T *d_a, *d_b;  // [height, width, channels]: written; d_b may be null
};

// The bits of all do not depend on the number of threads, nor on the instruction set. The map is
// [channels, height, width].
template <class T>
void ssim_map(const Ssim<T> &, T *map, int threads);
template <class T>
SsimSums ssim_sums(const Ssim<T> &, int threads);
template <class T>
void ssim_backward(const Ssim<T> &, const SsimGrads<T> &, int threads);

}  // namespace vlgs

#include "window.h"

#include <algorithm>

#include "isa.h"

namespace vlgs::VLGS_ISA_NS {

// One plane: each row is filtered across the rows into a line with room for zeros, then along it.
template <class T>
void filter_plane(const Window<T> &f, int64_t plane, T *line) {
  constexpr int64_t kHalf = kTaps / 2;
  const int64_t w = f.width;
  const T *in = f.in + plane * f.height * w;
  T *out = f.out + plane * f.height * w;
  T taps[kTaps];
  std::copy_n(f.taps, kTaps, taps);
  std::fill_n(line, w + 2 * kHalf, T(0));
  T *const middle = line + kHalf;
  for (int64_t y = 0; y < f.height; ++y) {
    if (y >= kHalf && y + kHalf < f.height) {
      const T *top = in + (y - kHalf) * w;
      for (int64_t x = 0; x < w; ++x) {
        T sum = 0;
        for (int k = 0; k < kTaps; ++k) sum += taps[k] * top[k * w + x];
        middle[x] = sum;
      }
    } else {
      std::fill_n(middle, w, T(0));
      for (int64_t k = std::max<int64_t>(0, kHalf - y); k < std::min<int64_t>(kTaps, f.height + kHalf - y);
           ++k)
        for (int64_t x = 0; x < w; ++x) middle[x] += taps[k] * in[(y + k - kHalf) * w + x];
    }
    for (int64_t x = 0; x < w; ++x) {
      T sum = 0;
      for (int k = 0; k < kTaps; ++k) sum += taps[k] * line[x + k];
      out[y * w + x] = sum;
    }
  }
}

template void filter_plane(const Window<float> &, int64_t, float *);
template void filter_plane(const Window<double> &, int64_t, double *);

}  // namespace vlgs::VLGS_ISA_NS

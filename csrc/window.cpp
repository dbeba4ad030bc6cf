#include "window.h"

#include <type_traits>

#include "isa.h"

namespace vlgs::VLGS_ISA_NS {
namespace {

constexpr int64_t kHalf = kTaps / 2;
constexpr int kMoments = 4;  // of p, q, p^2, q^2

template <class T>
void clear(T *numbers, int64_t count) {
  for (int64_t i = 0; i < count; ++i) numbers[i] = 0;
}
template <class T>
T not_negative(T x) {  // NaN stays NaN
  return x < 0 ? 0 : x;
}

// The row in the middle of kTaps rows, filtered across them.
template <class T>
void across(const T *const *rows, const T *given, int64_t width, T *__restrict out) {
  T taps[kTaps];
  for (int k = 0; k < kTaps; ++k) taps[k] = given[k];
  for (int64_t x = 0; x < width; ++x) {
    T sum = 0;
    for (int k = 0; k < kTaps; ++k) sum += taps[k] * rows[k][x];
    out[x] = sum;
  }
}

// Along a row that has kHalf zeros before and behind it.
template <class T>
void along(const T *line, const T *given, int64_t width, T *__restrict out) {
  T taps[kTaps];
  for (int k = 0; k < kTaps; ++k) taps[k] = given[k];
  for (int64_t x = 0; x < width; ++x) {
    T sum = 0;
    for (int k = 0; k < kTaps; ++k) sum += taps[k] * line[x + k];
    out[x] = sum;
  }
}

// Of one channel of a row. The step is a constant where it can be: GCC then vectorises the loop.
template <class T, class Step>
void moments(const T *a, const T *b, Step step, int64_t width, T *__restrict p, T *__restrict q,
             T *__restrict pp, T *__restrict qq) {
  for (int64_t x = 0; x < width; ++x) {
    const T total = a[x * step] + b[x * step], gap = a[x * step] - b[x * step];
    p[x] = total, q[x] = gap, pp[x] = total * total, qq[x] = gap * gap;
  }
}

}  // namespace

int64_t window_scratch(int64_t width) { return 2 * width + kTaps; }

template <class T>
void filter_plane(const Window<T> &f, int64_t plane, T *scratch) {
  const int64_t w = f.width;
  const T *in = f.in + plane * f.height * w;
  T *out = f.out + plane * f.height * w;
  T *const zeros = scratch, *const line = scratch + w;
  clear(zeros, window_scratch(w));
  for (int64_t y = 0; y < f.height; ++y) {
    const T *rows[kTaps];
    for (int64_t k = 0, at = y - kHalf; k < kTaps; ++k, ++at)
      rows[k] = at >= 0 && at < f.height ? in + at * w : zeros;
    across(rows, f.taps, w, line + kHalf);
    along(line, f.taps, w, out + y * w);
  }
}

int64_t similarity_scratch(int64_t width) { return window_scratch(width) + kMoments * (kTaps + 1) * width; }

// One channel. Of the moments the kTaps rows around the row at hand are kept, in a ring.
template <class T>
void similarity_plane(const Similarity<T> &s, int64_t channel, T *scratch) {
  const int64_t w = s.width;
  T *const zeros = scratch, *const line = zeros + w, *const filtered = scratch + window_scratch(w);
  clear(zeros, window_scratch(w));
  const auto row_of = [&](int moment, int64_t y) {
    return filtered + (kMoments + moment * kTaps + y % kTaps) * w;
  };
  const auto read = [&](int64_t y) {
    const T *a = s.a + y * w * s.channels + channel, *b = s.b + y * w * s.channels + channel;
    T *const rows[kMoments] = {row_of(0, y), row_of(1, y), row_of(2, y), row_of(3, y)};
    if (s.channels == 3)
      moments(a, b, std::integral_constant<int64_t, 3>(), w, rows[0], rows[1], rows[2], rows[3]);
    else
      moments(a, b, s.channels, w, rows[0], rows[1], rows[2], rows[3]);
  };
  for (int64_t y = 0; y < kHalf && y < s.height; ++y) read(y);
  for (int64_t y = 0; y < s.height; ++y) {
    if (y + kHalf < s.height) read(y + kHalf);
    for (int m = 0; m < kMoments; ++m) {
      const T *rows[kTaps];
      for (int64_t k = 0, at = y - kHalf; k < kTaps; ++k, ++at)
        rows[k] = at >= 0 && at < s.height ? row_of(m, at) : zeros;
      across(rows, s.taps, w, line + kHalf);
      along(line, s.taps, w, filtered + m * w);
    }
    const T *p = filtered, *q = p + w, *pp = q + w, *qq = pp + w;
    T *out = s.out + (channel * s.height + y) * w;
    for (int64_t x = 0; x < w; ++x) {
      const T p2 = p[x] * p[x], q2 = q[x] * q[x];
      const T var_p = not_negative(pp[x] - p2), var_q = not_negative(qq[x] - q2);
      const T luminance = (p2 - q2 + s.luminance_floor) / (p2 + q2 + s.luminance_floor);
      out[x] = luminance * ((var_p - var_q + s.structure_floor) / (var_p + var_q + s.structure_floor));
    }
  }
}

template void filter_plane(const Window<Number> &, int64_t, Number *);
template void similarity_plane(const Similarity<Number> &, int64_t, Number *);

}  // namespace vlgs::VLGS_ISA_NS

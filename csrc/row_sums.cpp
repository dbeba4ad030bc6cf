#include "row_sums.h"

#include <algorithm>
#include <atomic>

#include "threads.h"

namespace vlgs {
namespace {

// The number of features is known when this is compiled, or 0.
template <class T, int kFeatures>
int64_t grid(const RowSums<T> &s, int64_t g) {
  const int64_t features = kFeatures ? kFeatures : s.features, first = s.begins[g];
  const int64_t rows = (g + 1 < s.grids ? s.begins[g + 1] : s.count) - first;
  T *const d_table = s.d_table + first * features;
  std::fill_n(d_table, rows * features, T(0));
  int64_t strays = 0;
  for (int64_t i = 0; i < s.points; ++i) {
    const T *const d_sum = s.d_sums + (i * s.grids + g) * features;
    for (int64_t at = (g * s.points + i) * kCorners, end = at + kCorners; at < end; ++at) {
      const int64_t row = s.rows[at] - first;
      if (row < 0 || row >= rows) {
        ++strays;
        continue;
      }
      T *const to = d_table + row * features;
      const T weight = s.weights[at];
      for (int64_t f = 0; f < features; ++f) to[f] += d_sum[f] * weight;
    }
  }
  return strays;
}

}  // namespace

template <class T>
int64_t row_sums_backward(const RowSums<T> &s, int threads) {
  std::atomic<int64_t> strays = 0;
  for_each_in_turn(s.grids, threads, 1, [&](int64_t g, int) {
    strays += s.features == 8 ? grid<T, 8>(s, g) : s.features == 2 ? grid<T, 2>(s, g) : grid<T, 0>(s, g);
  });
  return strays;
}

template int64_t row_sums_backward(const RowSums<float> &, int);
template int64_t row_sums_backward(const RowSums<double> &, int);

}  // namespace vlgs

#include "squared_error.h"

#include "isa.h"
#include "simd.h"
#include "stretches.h"

namespace vlgs::VLGS_ISA_NS {
ErrorSum squared_error_chunk(const SquaredError<T> &e, int64_t begin, int64_t end) {
  Pack<T> sums = splat(T(0));
  ErrorSum total = {0, 0};
  for_stretches(e.valid, begin, end, [&](int64_t first, int64_t last, bool counts) {
    if (!counts) return;
    total.pixels += last - first;
    int64_t i = first * e.channels;
    const int64_t stop = last * e.channels;
    for (; i + kLanes <= stop; i += kLanes) {
      const Pack<T> gap = load(e.a + i) - load(e.b + i);
      sums = sums + gap * gap;
    }
    for (; i < stop; ++i) {
      const double gap = double(e.a[i] - e.b[i]);
      total.sum += gap * gap;
    }
  });
  T lanes[kLanes];
  store(lanes, sums);
  for (const T lane : lanes) total.sum += double(lane);
  return total;
}

void squared_error_chunk_backward(const SquaredError<T> &e, T scale, T *d_a, int64_t begin, int64_t end) {
  for_stretches(e.valid, begin, end, [&](int64_t first, int64_t last, bool counts) {
    const int64_t start = first * e.channels, stop = last * e.channels;
    if (counts)
      for (int64_t i = start; i < stop; ++i) d_a[i] = scale * (e.a[i] - e.b[i]);
    else
      for (int64_t i = start; i < stop; ++i) d_a[i] = 0;
  });
}

}  // namespace vlgs::VLGS_ISA_NS

#include "mapped_error.h"

#include <cmath>

#include "isa.h"
#include "simd.h"

namespace vlgs::VLGS_ISA_NS {

double mapped_error_pixels(const MappedError<T> &e, int64_t begin, int64_t end) {
  double total = 0;
  for (int64_t p = begin; p < end; ++p) {
    T *__restrict made = e.made + p * e.width;
    const T *__restrict bias = e.bias, *__restrict wanted = e.wanted + e.which[p] * e.width;
    T sums[kLanes] = {};
    int64_t i = 0;
    for (; i + kLanes <= e.width; i += kLanes)
      for (int lane = 0; lane < kLanes; ++lane) {
        const T gap = (made[i + lane] + bias[i + lane]) - wanted[i + lane];
        sums[lane] += std::abs(gap);
        made[i + lane] = T((gap > 0) - (gap < 0)) * e.scale;
      }
    for (; i < e.width; ++i) {
      const T gap = (made[i] + bias[i]) - wanted[i];
      total += std::abs(gap);
      made[i] = T((gap > 0) - (gap < 0)) * e.scale;
    }
    for (const T sum : sums) total += double(sum);
  }
  return total;
}

}  // namespace vlgs::VLGS_ISA_NS

// Squared differences of two images over the pixels that count, and their gradient.
#pragma once

#include <cstdint>

namespace vlgs {

template <class T>
struct SquaredError {
  int64_t pixels, channels;
  const T *a, *b;     // [pixels, channels]
  const bool *valid;  // [pixels]; null where all count. At others b is never read.
};

struct ErrorSum {
  double sum;
  int64_t pixels;  // that count
};

// The bits of both do not depend on the number of threads, nor on the instruction set.
template <class T>
ErrorSum squared_error(const SquaredError<T> &, int threads);
// d_a = scale (a - b), and 0 at pixels that do not count.
template <class T>
void squared_error_backward(const SquaredError<T> &, T scale, T *d_a, int threads);

}  // namespace vlgs

// Huber's loss of a map that may be a part of a wider one, over the pixels that count, and its gradient.
#pragma once

#include <cstdint>

namespace vlgs {

template <class T>
struct Huber {
  int64_t height, width, channels;
  int64_t row, pixel;  // numbers of `image` from one row, and from one pixel, to the next
  const T *image;
  const T *target;    // [height, width, channels]
  const bool *valid;  // [height, width]
  T delta;
  T *clamped;  // [height, width, channels]: image - target within plus and minus delta, 0 at pixels that do
               // not count
};

// Sum of x (d - x / 2) with d the difference and x the clamped one. Bits do not depend on the number of
// threads.
template <class T>
double huber(const Huber<T> &, int threads);

}  // namespace vlgs

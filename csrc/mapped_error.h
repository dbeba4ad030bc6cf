// The absolute error of embeddings that a linear map makes, and their gradient in the place of them.
#pragma once

#include <cstdint>

namespace vlgs {

template <class T>
struct MappedError {
  int64_t pixels, width;
  T *made;               // [pixels, width] without the bias; becomes scale * sign(made + bias - wanted)
  const T *bias;         // [width]
  const T *wanted;       // [count, width]
  const int64_t *which;  // [pixels]: row of `wanted`, which is there
  T scale;
};

// Sum of |made + bias - wanted|. The bits of both depend neither on the number of threads nor on the
// instruction set.
template <class T>
double mapped_error(const MappedError<T> &, int threads);

}  // namespace vlgs

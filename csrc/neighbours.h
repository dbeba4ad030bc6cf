// The gradient of the products of neighbouring pixels.
#pragma once

#include <cstdint>

namespace vlgs {

template <class T>
struct Neighbours {
  int64_t height, width, channels;
  const T *image;       // [height, width, channels]
  const T *d_products;  // [8, height - 2, width - 2]: of each inner pixel with those around it, row by row
  T *d_image;           // [height, width, channels]
};

// Terms are added in the order of PyTorch's: as a neighbour of others, last neighbour first, then as an inner
// pixel.
template <class T>
void neighbours_backward(const Neighbours<T> &, int threads);

}  // namespace vlgs

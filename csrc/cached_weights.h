// A view whose Gaussians stay as they are: the weights a T of every block of pixels and Gaussian are kept,
// and what is left of rendering is a sparse product with the values.
#pragma once

#include "rasterizer.h"

namespace vlgs {

template <class T>
class CachedWeights {
 public:
  // Counts the weights of the first chain of a picture; `keep` then writes them. In between `bytes` says what
  // they will take.
  CachedWeights(const Rasterized<T> &, int threads);
  void keep(const Rasterized<T> &, int threads);

  int64_t bytes() const;
  bool kept() const { return kept_; }
  int64_t rows() const { return n_; }
  int64_t height() const { return grid_.height; }
  int64_t width() const { return grid_.width; }
  // values [n, channels] to image [height, width, channels], and back. Throw std::invalid_argument naming the
  // first number that is not finite.
  void render(const T *values, int64_t channels, T *image, int threads) const;
  void backward(const T *d_image, int64_t channels, T *d_values, int threads) const;

 private:
  void index_by_gaussian();

  int64_t n_;
  Grid grid_;
  bool kept_ = false;
  std::vector<int64_t> block_begin_;  // [blocks + 1] entries of a block, front to back
  Buffer<uint32_t> ids_;              // [entries] row of the Gaussian
  Buffer<T> weights_;                 // [entries, kPixels]
  std::vector<int64_t> row_begin_;    // [n + 1]
  Buffer<uint32_t> entries_;  // [entries + kCachedWeightsAhead] those of a row, in the order of the blocks
  Buffer<uint32_t> blocks_;   // [entries] their blocks
};

}  // namespace vlgs

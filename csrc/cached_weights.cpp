#include "cached_weights.h"

#include <algorithm>
#include <limits>
#include <stdexcept>
#include <string>
#include <utility>

#include "checks.h"
#include "threads.h"

namespace vlgs {
namespace {

constexpr int64_t kRowsAtOnce = 64;
// Gaussians meet the gradients of a block in no order that a cache could follow: so many channels of all
// blocks of a small view stay in it. A multiple of those that a kernel sums at once.
constexpr int64_t kChannelsAtOnce = 32;

}  // namespace

template <class T>
CachedWeights<T>::CachedWeights(const Rasterized<T> &picture, int threads)
    : n_(picture.rows()), grid_(picture.pass().grid), row_begin_(size_t(n_) + 1) {
  const int64_t tiles = grid_.tiles_x * grid_.tiles_y;
  block_begin_.assign(size_t(tiles) * kBlocks + 1, 0);
  for_each_in_turn(tiles, threads, 1, [&](int64_t tile, int) {
    kernels<T>().cache_weights(picture.pass(), tile, block_begin_.data() + tile * kBlocks, nullptr, nullptr);
  });
  int64_t entries = 0;
  for (int64_t &count : block_begin_) entries += std::exchange(count, entries);
  if (std::max(entries, tiles * kBlocks) > int64_t(std::numeric_limits<uint32_t>::max()))
    throw std::invalid_argument("cached view: weights must be fewer than 2^32, got " +
                                std::to_string(entries));
}

template <class T>
void CachedWeights<T>::keep(const Rasterized<T> &picture, int threads) {
  const int64_t tiles = grid_.tiles_x * grid_.tiles_y, entries = block_begin_.back();
  ids_ = Buffer<uint32_t>(entries);
  weights_ = Buffer<T>(entries * kPixels);
  for_each_in_turn(tiles, threads, 1, [&](int64_t tile, int) {
    int64_t counts[kBlocks];
    const int64_t *begin = block_begin_.data() + tile * kBlocks;
    kernels<T>().cache_weights(picture.pass(), tile, counts, ids_.data() + begin[0],
                               weights_.data() + begin[0] * kPixels);
  });
  index_by_gaussian();
  kept_ = true;
}

template <class T>
void CachedWeights<T>::index_by_gaussian() {
  const int64_t entries = block_begin_.back();
  for (int64_t k = 0; k < entries; ++k) ++row_begin_[ids_[k]];
  int64_t place = 0;
  for (int64_t &count : row_begin_) place += std::exchange(count, place);
  std::vector<int64_t> next(row_begin_);
  entries_ = Buffer<uint32_t>(entries + kCachedWeightsAhead);
  blocks_ = Buffer<uint32_t>(entries);
  for (size_t block = 0; block + 1 < block_begin_.size(); ++block)
    for (int64_t k = block_begin_[block]; k < block_begin_[block + 1]; ++k) {
      const int64_t to = next[ids_[k]]++;
      entries_[to] = uint32_t(k), blocks_[to] = uint32_t(block);
    }
  std::fill(entries_.data() + entries, entries_.data() + entries + kCachedWeightsAhead, 0u);
}

template <class T>
int64_t CachedWeights<T>::bytes() const {
  return block_begin_.back() * int64_t(kPixels * sizeof(T) + 3 * sizeof(uint32_t)) +
         int64_t((block_begin_.size() + row_begin_.size()) * sizeof(int64_t));
}

template <class T>
void CachedWeights<T>::render(const T *values, int64_t channels, T *image, int threads) const {
  if (any_not_finite(values, n_ * channels))
    check_rows("values of a cached view must be finite", values, n_, channels, -kLargest, kLargest);
  const Kernels<T> &kernel = kernels<T>();
  const int64_t blocks = int64_t(block_begin_.size()) - 1;
  const Buffer<T> scratch(threads * channels * kPixels);
  for_each_in_turn(blocks, threads, kBlocks, [&](int64_t block, int thread) {
    const int64_t begin = block_begin_[block];
    kernel.cached_weights_render(grid_, block, block_begin_[block + 1] - begin, ids_.data() + begin,
                                 weights_.data() + begin * kPixels, values, channels,
                                 scratch.data() + thread * channels * kPixels, image);
  });
}

// By Gaussian, each by one thread and over its blocks in order, so that the bits do not depend on the
// threads.
template <class T>
void CachedWeights<T>::backward(const T *d_image, int64_t channels, T *d_values, int threads) const {
  const int64_t pixels = grid_.height * grid_.width, blocks = int64_t(block_begin_.size()) - 1;
  if (any_not_finite(d_image, pixels * channels))
    check_rows("gradient of a cached view must be finite", d_image, pixels, channels, -kLargest, kLargest);
  const Kernels<T> &kernel = kernels<T>();
  const Buffer<T> upstream(blocks * std::min(channels, kChannelsAtOnce) * kPixels);
  for (int64_t first = 0; first < channels; first += kChannelsAtOnce) {
    const int64_t count = std::min(channels - first, kChannelsAtOnce);
    for_each(blocks, threads, [&](int64_t block) {
      kernel.cached_weights_upstream(grid_, block, d_image + first, channels, count,
                                     upstream.data() + block * count * kPixels);
    });
    for_each_in_turn(n_, threads, kRowsAtOnce, [&](int64_t i, int) {
      const int64_t begin = row_begin_[i];
      kernel.cached_weights_backward(row_begin_[i + 1] - begin, entries_.data() + begin,
                                     blocks_.data() + begin, weights_.data(), upstream.data(), count,
                                     d_values + i * channels + first);
    });
  }
}

template class CachedWeights<float>;
template class CachedWeights<double>;

}  // namespace vlgs

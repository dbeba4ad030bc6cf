// Chunks of fixed size, whatever the number of threads, and their sums added in order.
#include <algorithm>

#include "buffer_pool.h"
#include "kernels.h"
#include "threads.h"

namespace vlgs {
namespace {

constexpr int64_t kNumbersAtOnce = 1 << 14;
// Fewer chunks than this are done before another thread is awake.
constexpr int64_t kWorthChunks = 16;

template <class T>
struct Chunks {
  const SquaredError<T> &e;
  int64_t pixels = std::max<int64_t>(1, kNumbersAtOnce / std::max<int64_t>(1, e.channels));
  int64_t count = (e.pixels + pixels - 1) / pixels;

  int64_t begin(int64_t c) const { return c * pixels; }
  int64_t end(int64_t c) const { return std::min(e.pixels, begin(c) + pixels); }
  int threads(int wanted) const { return count < kWorthChunks ? 1 : wanted; }
};

}  // namespace

template <class T>
ErrorSum squared_error(const SquaredError<T> &e, int threads) {
  const Chunks<T> chunks{e};
  const Buffer<ErrorSum> sums(chunks.count);
  for_each(chunks.count, chunks.threads(threads),
           [&](int64_t c) { sums[c] = kernels<T>().squared_error_chunk(e, chunks.begin(c), chunks.end(c)); });
  ErrorSum total = {0, 0};
  for (int64_t c = 0; c < chunks.count; ++c) total.sum += sums[c].sum, total.pixels += sums[c].pixels;
  return total;
}

template <class T>
void squared_error_backward(const SquaredError<T> &e, T scale, T *d_a, int threads) {
  const Chunks<T> chunks{e};
  for_each(chunks.count, chunks.threads(threads), [&](int64_t c) {
    kernels<T>().squared_error_chunk_backward(e, scale, d_a, chunks.begin(c), chunks.end(c));
  });
}

template ErrorSum squared_error(const SquaredError<float> &, int);
template ErrorSum squared_error(const SquaredError<double> &, int);
template void squared_error_backward(const SquaredError<float> &, float, float *, int);
template void squared_error_backward(const SquaredError<double> &, double, double *, int);

}  // namespace vlgs

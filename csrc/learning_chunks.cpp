// What each thread takes of RAdam's steps, of errors of wide maps and of neighbours.
#include <algorithm>

#include "buffer_pool.h"
#include "huber.h"
#include "kernels.h"
#include "threads.h"

namespace vlgs {
namespace {

constexpr int64_t kNumbersAtOnce = 1 << 14;

// Calls with stretches of so many numbers.
template <class Call>
void for_chunks(int64_t count, int threads, const Call &call) {
  const int64_t chunks = (count + kNumbersAtOnce - 1) / kNumbersAtOnce;
  for_each(chunks, chunks < 2 ? 1 : threads,
           [&](int64_t c) { call(c * kNumbersAtOnce, std::min(count, (c + 1) * kNumbersAtOnce)); });
}

// Memory is what this waits for, whatever the instruction set.
template <class T>
double huber_row(const Huber<T> &h, int64_t y) {
  double total = 0;
  for (int64_t x = 0; x < h.width; ++x) {
    const int64_t at = y * h.width + x;
    T *__restrict clamped = h.clamped + at * h.channels;
    if (!h.valid[at]) {
      std::fill_n(clamped, h.channels, T(0));
      continue;
    }
    const T *__restrict image = h.image + y * h.row + x * h.pixel, *__restrict target =
                                                                       h.target + at * h.channels;
    constexpr int kSums = 8;
    T sums[kSums] = {};
    int64_t c = 0;
    const auto one = [&](int64_t i) {
      const T gap = image[i] - target[i];
      // NaN stays what it is.
      const T least = gap < -h.delta ? -h.delta : gap;
      clamped[i] = least > h.delta ? h.delta : least;
      return clamped[i] * (gap - clamped[i] / 2);
    };
    for (; c + kSums <= h.channels; c += kSums)
      for (int k = 0; k < kSums; ++k) sums[k] += one(c + k);
    for (; c < h.channels; ++c) total += double(one(c));
    for (const T sum : sums) total += double(sum);
  }
  return total;
}

}  // namespace

template <class T>
void radam_moments(const RAdamMoments<T> &r, int threads) {
  for_chunks(r.count, threads,
             [&](int64_t begin, int64_t end) { kernels<T>().radam_moments_of(r, begin, end); });
}

template <class T>
void radam_weights(const RAdamWeights<T> &r, int threads) {
  for_chunks(r.count, threads,
             [&](int64_t begin, int64_t end) { kernels<T>().radam_weights_of(r, begin, end); });
}

template <class T>
double mapped_error(const MappedError<T> &e, int threads) {
  const int64_t pixels = std::max<int64_t>(1, kNumbersAtOnce / std::max<int64_t>(1, e.width));
  const int64_t chunks = (e.pixels + pixels - 1) / pixels;
  const Buffer<double> sums(chunks);
  for_each(chunks, chunks < 2 ? 1 : threads, [&](int64_t c) {
    sums[c] = kernels<T>().mapped_error_pixels(e, c * pixels, std::min(e.pixels, (c + 1) * pixels));
  });
  double total = 0;
  for (int64_t c = 0; c < chunks; ++c) total += sums[c];
  return total;
}

template <class T>
void neighbours_backward(const Neighbours<T> &n, int threads) {
  for_each(n.height, worth(n.height * n.width * n.channels, threads),
           [&](int64_t y) { kernels<T>().neighbours_backward_row(n, y); });
}

template <class T>
double huber(const Huber<T> &h, int threads) {
  const Buffer<double> sums(h.height);
  for_each(h.height, worth(h.height * h.width * h.channels, threads),
           [&](int64_t y) { sums[y] = huber_row(h, y); });
  double total = 0;
  for (int64_t y = 0; y < h.height; ++y) total += sums[y];
  return total;
}

template void radam_moments(const RAdamMoments<float> &, int);
template void radam_moments(const RAdamMoments<double> &, int);
template void radam_weights(const RAdamWeights<float> &, int);
template void radam_weights(const RAdamWeights<double> &, int);
template double mapped_error(const MappedError<float> &, int);
template double mapped_error(const MappedError<double> &, int);
template void neighbours_backward(const Neighbours<float> &, int);
template void neighbours_backward(const Neighbours<double> &, int);
template double huber(const Huber<float> &, int);
template double huber(const Huber<double> &, int);

}  // namespace vlgs

// Bands of rows, one for each thread; a row's numbers do not depend on the band that it is in.
#include <algorithm>

#include "buffer_pool.h"
#include "kernels.h"
#include "threads.h"

namespace vlgs {
namespace {

// A band reads kTaps - 1 rows of its neighbours (backward twice as many) again.
constexpr int64_t kWorthBand = 32;

template <class T, class Call>
void for_bands(const Ssim<T> &s, int64_t scratch_size, int threads, Call call) {
  const int bands = int(std::clamp<int64_t>(s.height / kWorthBand, 1, threads));
  const Buffer<T> scratch(bands * scratch_size);
  for_shares(bands, [&](int band) {
    const Range rows = share(s.height, band, bands);
    call(rows.begin, rows.end, scratch.data() + band * scratch_size);
  });
}

}  // namespace

template <class T>
void ssim_map(const Ssim<T> &s, T *map, int threads) {
  for_bands(s, kernels<T>().ssim_scratch(s), threads, [&](int64_t begin, int64_t end, T *scratch) {
    kernels<T>().ssim_map_rows(s, map, begin, end, scratch);
  });
}

template <class T>
SsimSums ssim_sums(const Ssim<T> &s, int threads) {
  const Buffer<SsimSums> rows(s.height);
  for_bands(s, kernels<T>().ssim_scratch(s), threads, [&](int64_t begin, int64_t end, T *scratch) {
    kernels<T>().ssim_sum_rows(s, rows.data(), begin, end, scratch);
  });
  SsimSums total = {0, 0, 0};
  for (int64_t y = 0; y < s.height; ++y) {
    total.distance += rows[y].distance;
    total.dissimilarity += rows[y].dissimilarity;
    total.pixels += rows[y].pixels;
  }
  return total;
}

template <class T>
void ssim_backward(const Ssim<T> &s, const SsimGrads<T> &d, int threads) {
  for_bands(s, kernels<T>().ssim_backward_scratch(s), threads, [&](int64_t begin, int64_t end, T *scratch) {
    kernels<T>().ssim_backward_rows(s, d, begin, end, scratch);
  });
}

template void ssim_map(const Ssim<float> &, float *, int);
template void ssim_map(const Ssim<double> &, double *, int);
template SsimSums ssim_sums(const Ssim<float> &, int);
template SsimSums ssim_sums(const Ssim<double> &, int);
template void ssim_backward(const Ssim<float> &, const SsimGrads<float> &, int);
template void ssim_backward(const Ssim<double> &, const SsimGrads<double> &, int);

}  // namespace vlgs

// Attention over all Gaussians: chunks of fixed size, whatever the number of threads, and sums over chunks in
// their order.
#include <algorithm>

#include "buffer_pool.h"
#include "kernels.h"
#include "threads.h"

namespace vlgs {
namespace {

constexpr int64_t kGaussiansAtOnce = 2048;
constexpr int64_t kLanes = 16;  // of simd.h: one sum per lane

}  // namespace

template <class T>
void attention(const Attention<T> &a, int64_t n, Fused<T *> out, int threads) {
  threads = worth(n, threads);
  const int64_t chunks = (n + kGaussiansAtOnce - 1) / kGaussiansAtOnce;
  const int64_t size = kernels<T>().attention_scratch(a.shape);
  const Buffer<T> scratch(threads * size);
  for_each_in_turn(chunks, threads, 1, [&](int64_t c, int thread) {
    const int64_t begin = c * kGaussiansAtOnce;
    kernels<T>().attention(a, out, begin, std::min(n, begin + kGaussiansAtOnce),
                           scratch.data() + thread * size);
  });
}

template <class T>
void attention_backward(const Attention<T> &a, int64_t n, Fused<const T *> d_out, Fused<T *> d_in,
                        AttentionLayers<T *> d_layers, int threads) {
  using Layers = AttentionLayers<T *>;
  threads = worth(n, threads);
  const int64_t chunks = (n + kGaussiansAtOnce - 1) / kGaussiansAtOnce;
  const int64_t size = kernels<T>().attention_scratch(a.shape);
  AttentionLayers<int64_t> counts = layer_sizes(a.shape);
  int64_t total = 0;
  for (int i = 0; i < Layers::kCount; ++i) total += counts[i];
  const Buffer<T> scratch(threads * size), lanes(threads * total * kLanes), sums(chunks * total);
  for_each_in_turn(chunks, threads, 1, [&](int64_t c, int thread) {
    const int64_t begin = c * kGaussiansAtOnce;
    T *mine = lanes.data() + thread * total * kLanes;
    std::fill_n(mine, total * kLanes, T(0));
    Layers at;
    T *free = mine;
    for (int i = 0; i < Layers::kCount; ++i) at[i] = free, free += counts[i] * kLanes;
    kernels<T>().attention_backward(a, d_out, d_in, begin, std::min(n, begin + kGaussiansAtOnce),
                                    scratch.data() + thread * size, at);
    for (int64_t k = 0; k < total; ++k) {
      T sum = 0;
      for (int64_t l = 0; l < kLanes; ++l) sum += mine[k * kLanes + l];
      sums[c * total + k] = sum;
    }
  });
  int64_t first = 0;
  for (int i = 0; i < Layers::kCount; first += counts[i++])
    for (int64_t k = 0; k < counts[i]; ++k) {
      double sum = 0;
      for (int64_t c = 0; c < chunks; ++c) sum += double(sums[c * total + first + k]);
      d_layers[i][k] = T(sum);
    }
}

template void attention(const Attention<float> &, int64_t, Fused<float *>, int);
template void attention(const Attention<double> &, int64_t, Fused<double *>, int);
template void attention_backward(const Attention<float> &, int64_t, Fused<const float *>, Fused<float *>,
                                 AttentionLayers<float *>, int);
template void attention_backward(const Attention<double> &, int64_t, Fused<const double *>, Fused<double *>,
                                 AttentionLayers<double *>, int);

}  // namespace vlgs

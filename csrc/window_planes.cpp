#include <omp.h>

#include "buffer.h"
#include "kernels.h"

namespace vlgs {

template <class T>
void filter(const Window<T> &f, int threads) {
  const int64_t size = kernels<T>().window_scratch(f.width);
  const Buffer<T> scratch(threads * size);
#pragma omp parallel for num_threads(threads)
  for (int64_t plane = 0; plane < f.planes; ++plane)
    kernels<T>().filter_plane(f, plane, scratch.data() + omp_get_thread_num() * size);
}

template <class T>
void similarity(const Similarity<T> &s, int threads) {
  const int64_t size = kernels<T>().similarity_scratch(s.width);
  const Buffer<T> scratch(threads * size);
#pragma omp parallel for num_threads(threads)
  for (int64_t channel = 0; channel < s.channels; ++channel)
    kernels<T>().similarity_plane(s, channel, scratch.data() + omp_get_thread_num() * size);
}

template void filter(const Window<float> &, int);
template void filter(const Window<double> &, int);
template void similarity(const Similarity<float> &, int);
template void similarity(const Similarity<double> &, int);

}  // namespace vlgs

#include <omp.h>

#include "buffer.h"
#include "kernels.h"

namespace vlgs {

template <class T>
void filter(const Window<T> &f, int threads) {
  const int64_t size = f.width + kTaps;
  const Buffer<T> lines(threads * size);
#pragma omp parallel for num_threads(threads)
  for (int64_t plane = 0; plane < f.planes; ++plane)
    kernels<T>().filter_plane(f, plane, lines.data() + omp_get_thread_num() * size);
}

template void filter(const Window<float> &, int);
template void filter(const Window<double> &, int);

}  // namespace vlgs

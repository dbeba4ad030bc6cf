// Bands of pixels, one after the other for each thread.
#include "code_table.h"
#include "kernels.h"
#include "threads.h"

namespace vlgs {

template <class T>
int64_t code_table(const CodeTable<T> &t, int threads) {
  const int bands = worth(t.pixels, threads);
  int64_t lacking = 0;
#pragma omp parallel for num_threads(bands) reduction(+ : lacking)
  for (int band = 0; band < bands; ++band) {
    const Range range = share(t.pixels, band, bands);
    lacking += kernels<T>().code_table_pixels(t, range.begin, range.end);
  }
  return lacking;
}

template int64_t code_table(const CodeTable<float> &, int);
template int64_t code_table(const CodeTable<double> &, int);

}  // namespace vlgs

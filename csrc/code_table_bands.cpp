// Bands of pixels, one for each thread.
#include <atomic>

#include "code_table.h"
#include "kernels.h"
#include "threads.h"

namespace vlgs {

template <class T>
int64_t code_table(const CodeTable<T> &t, int threads) {
  const int bands = worth(t.pixels, threads);
  std::atomic<int64_t> lacking = 0;
  for_shares(bands, [&](int band) {
    const Range range = share(t.pixels, band, bands);
    lacking += kernels<T>().code_table_pixels(t, range.begin, range.end);
  });
  return lacking;
}

template int64_t code_table(const CodeTable<float> &, int);
template int64_t code_table(const CodeTable<double> &, int);

}  // namespace vlgs

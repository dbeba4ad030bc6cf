#include <algorithm>
#include <atomic>
#include <limits>

#include "checks.h"
#include "rasterizer.h"
#include "threads.h"

namespace vlgs {
namespace {

constexpr int64_t kRowsAtOnce = 1024;

}  // namespace

template <class T>
void project(const Camera &camera, int64_t n, const Gaussians<T> &g, const Splats<T> &out, int threads) {
  threads = worth(n, threads);
  std::atomic<bool> bad = false;
  const int64_t chunks = (n + kRowsAtOnce - 1) / kRowsAtOnce;
  for_each(chunks, threads, [&](int64_t c) {
    const int64_t begin = c * kRowsAtOnce, end = std::min(n, begin + kRowsAtOnce), count = end - begin;
    if (any_not_finite(g.means + 3 * begin, 3 * count) || any_not_finite(g.quats + 4 * begin, 4 * count) ||
        any_outside(g.scales + 3 * begin, 3 * count, T(0), std::numeric_limits<T>::max()))
      bad = true;
    else
      kernels<T>().project(camera, g, out, begin, end);
  });
  if (!bad) return;
  check_rows("means must be finite", g.means, n, 3, -kLargest, kLargest);
  check_rows("quats must be finite", g.quats, n, 4, -kLargest, kLargest);
  check_rows("scales must be finite and >= 0", g.scales, n, 3, 0, kLargest);
}

template <class T>
void project_backward(const Camera &camera, int64_t n, const Gaussians<T> &g, const GaussianGrads<T> &d,
                      int threads) {
  threads = worth(n, threads);
  std::atomic<bool> bad = false;
  const int64_t chunks = (n + kRowsAtOnce - 1) / kRowsAtOnce;
  for_each(chunks, threads, [&](int64_t c) {
    const int64_t begin = c * kRowsAtOnce, end = std::min(n, begin + kRowsAtOnce), count = end - begin;
    kernels<T>().project_backward(camera, g, d, begin, end);
    if (any_not_finite(d.d_means + 3 * begin, 3 * count) ||
        any_not_finite(d.d_quats + 4 * begin, 4 * count) || any_not_finite(d.d_scales + 3 * begin, 3 * count))
      bad = true;
  });
  if (!bad) return;
  check_rows("gradient of means must be finite", d.d_means, n, 3, -kLargest, kLargest);
  check_rows("gradient of quats must be finite", d.d_quats, n, 4, -kLargest, kLargest);
  check_rows("gradient of scales must be finite", d.d_scales, n, 3, -kLargest, kLargest);
}

template void project(const Camera &, int64_t, const Gaussians<float> &, const Splats<float> &, int);
template void project(const Camera &, int64_t, const Gaussians<double> &, const Splats<double> &, int);
template void project_backward(const Camera &, int64_t, const Gaussians<float> &,
                               const GaussianGrads<float> &, int);
template void project_backward(const Camera &, int64_t, const Gaussians<double> &,
                               const GaussianGrads<double> &, int);
}  // namespace vlgs

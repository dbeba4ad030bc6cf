#include "neighbours.h"

#include "isa.h"
#include "simd.h"

namespace vlgs::VLGS_ISA_NS {
namespace {

// Pixels that are multiplied and added up.
struct Terms {
  int count = 0;
  const T *pixel[8];
  T factor[8];

  void add(const T *other, T times) {
    pixel[count] = other;
    factor[count++] = times;
  }
  VLGS_INLINE Pack<T> packs(int64_t i) const {
    Pack<T> sum = splat(T(0));
    for (int k = 0; k < count; ++k) sum = sum + splat(factor[k]) * load(pixel[k] + i);
    return sum;
  }
  T number(int64_t i) const {
    T sum = 0;
    for (int k = 0; k < count; ++k) sum += factor[k] * pixel[k][i];
    return sum;
  }
};

inline bool within(int64_t i, int64_t end) { return i >= 0 && i < end; }

}  // namespace

void neighbours_backward_row(const Neighbours<T> &n, int64_t y) {
  const int64_t rows = n.height - 2, columns = n.width - 2;  // of inner pixels
  for (int64_t x = 0; x < n.width; ++x) {
    const bool is_inner = within(y - 1, rows) && within(x - 1, columns);
    Terms beside, inner;
    for (int k = 7; k >= 0; --k) {
      const int place = k < 4 ? k : k + 1;  // in the 3x3 pixels around an inner one
      const int64_t dy = place / 3, dx = place % 3;
      const int64_t of_place = k * rows * columns;  // in d_products, which is null without an inner pixel
      if (within(y - dy, rows) && within(x - dx, columns))
        beside.add(n.image + ((y - dy + 1) * n.width + x - dx + 1) * n.channels,
                   n.d_products[of_place + (y - dy) * columns + x - dx]);
      if (is_inner)
        inner.add(n.image + ((y + dy - 1) * n.width + x + dx - 1) * n.channels,
                  n.d_products[of_place + (y - 1) * columns + x - 1]);
    }
    T *const to = n.d_image + (y * n.width + x) * n.channels;
    int64_t i = 0;
    for (; i + kLanes <= n.channels; i += kLanes) store(to + i, beside.packs(i) + inner.packs(i));
    for (; i < n.channels; ++i) to[i] = beside.number(i) + inner.number(i);
  }
}

}  // namespace vlgs::VLGS_ISA_NS

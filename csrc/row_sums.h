// The gradient of a table whose weighted rows were summed: every row gets the gradients of the sums that it
// is in.
#pragma once

#include <cstdint>

namespace vlgs {

constexpr int kCorners = 8;

template <class T>
struct RowSums {
  int64_t grids, points, features, count;
  const int64_t *begins;  // [grids]: rows [begins[g], begins[g + 1]) of the table are those of grid g
  const int32_t *rows;    // [grids, points, kCorners]
  const T *weights;       // the same shape
  const T *d_sums;        // [points, grids, features]
  T *d_table;             // [count, features]
};

// Adds in the order of points and corners whatever the threads, as each grid has rows of its own. Returns how
// many rows are those of another grid: these are left out.
template <class T>
int64_t row_sums_backward(const RowSums<T> &, int threads);

}  // namespace vlgs

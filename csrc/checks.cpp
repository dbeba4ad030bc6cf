#include "checks.h"

#include <algorithm>
#include <stdexcept>

namespace vlgs {

template <class T>
void check_rows(const std::string &what, const T *data, int64_t rows, int64_t width, double low,
                double high) {
  int64_t first = -1, found = 0;
  double got = 0;
  for (int64_t i = 0; i < rows; ++i) {
    const T *row = data + i * width;
    const T *bad = std::find_if(row, row + width, [&](T x) { return !(x >= low && x <= high); });
    if (bad == row + width) continue;
    if (found++ == 0) first = i, got = double(*bad);
  }
  if (found)
    throw std::invalid_argument("rasterize: " + what + ", got " + std::to_string(got) + " in row " +
                                std::to_string(first) + " (" + std::to_string(found) +
                                (found == 1 ? " row" : " rows") + ")");
}

template void check_rows(const std::string &, const float *, int64_t, int64_t, double, double);
template void check_rows(const std::string &, const double *, int64_t, int64_t, double, double);

}  // namespace vlgs

#include "code_table.h"

#include <cstring>
#include <limits>

#include "isa.h"

namespace vlgs::VLGS_ISA_NS {
namespace {

constexpr int kCorners = 8;
typedef T Lanes __attribute__((vector_size(kTableLanes * sizeof(T))));

// Rows of the corners of the cell that a code is in, and what each counts; false where one of them is
// missing.
inline bool corners(const CodeTable<T> &t, const T *code, const T **rows, T *weights) {
  int64_t node = 0;
  T part[3];
  for (int axis = 0; axis < 3; ++axis) {
    const T at = (code[axis] - t.low) * t.per_unit;
    if (!(at >= 0 && at < T(t.side - 1))) return false;  // nor is NaN inside
    const int64_t cell = int64_t(at);
    part[axis] = at - T(cell);
    node = node * t.side + cell;
  }
  for (int corner = 0; corner < kCorners; ++corner) {
    const int x = corner >> 2, y = corner >> 1 & 1, z = corner & 1;
    const int64_t row = t.places[node + (x * t.side + y) * t.side + z];
    if (row < 0 || row >= t.count) return false;
    rows[corner] = t.rows + row * t.padded;
    weights[corner] = (x ? part[0] : 1 - part[0]) * (y ? part[1] : 1 - part[1]) * (z ? part[2] : 1 - part[2]);
  }
  return true;
}

}  // namespace

int64_t code_table_pixels(const CodeTable<T> &t, int64_t begin, int64_t end) {
  int64_t lacking = 0;
  for (int64_t i = begin; i < end; ++i) {
    const T *rows[kCorners];
    T weights[kCorners];
    if (!corners(t, t.codes + 3 * i, rows, weights)) {
      ++lacking;
      for (int64_t word = 0; word < t.words; ++word)
        t.out[word * t.pixels + i] = std::numeric_limits<T>::quiet_NaN();
      continue;
    }
    for (int64_t first = 0; first < t.words; first += kTableLanes) {
      Lanes sum = {};
      for (int corner = 0; corner < kCorners; ++corner) {
        Lanes row;
        std::memcpy(&row, rows[corner] + first, sizeof row);
        sum += weights[corner] * row;
      }
      const int64_t stop = t.words - first < kTableLanes ? t.words - first : kTableLanes;
      for (int64_t word = 0; word < stop; ++word) t.out[(first + word) * t.pixels + i] = sum[word];
    }
  }
  return lacking;
}

}  // namespace vlgs::VLGS_ISA_NS

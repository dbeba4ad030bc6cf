// Refuses input that is not finite. A fast test looks at everything; only if it fails, a slow one finds the
// name and the row for the error.
#pragma once

#include <bit>
#include <cmath>
#include <cstdint>
#include <string>
#include <type_traits>

namespace vlgs {

// Whether any of `count` numbers is not finite. Integers only, so that the loop becomes vector code.
template <class T>
bool any_not_finite(const T *data, int64_t count) {
  using Bits = std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t>;
  constexpr Bits kExponent = std::bit_cast<Bits>(T(INFINITY));
  Bits bad = 0;
  for (int64_t i = 0; i < count; ++i) bad |= (std::bit_cast<Bits>(data[i]) & kExponent) == kExponent;
  return bad != 0;
}

// Whether any of `count` numbers lies outside [low, high]; what is not a number does.
template <class T>
bool any_outside(const T *data, int64_t count, T low, T high) {
  int bad = 0;
  for (int64_t i = 0; i < count; ++i) bad |= !((data[i] >= low) & (data[i] <= high));
  return bad != 0;
}

// Throws std::invalid_argument if a number of `data` [rows, width] is outside [low, high]: "rasterize:
// <what>, got <number> in row <first> (<how many> rows)".
template <class T>
void check_rows(const std::string &what, const T *data, int64_t rows, int64_t width, double low, double high);

constexpr double kLargest = 1.7976931348623157e308;

}  // namespace vlgs

// Answers to words, tabulated over a cube of code space and interpolated between its nodes.
#pragma once

#include <cstdint>

namespace vlgs {

constexpr int kTableLanes = 8;  // numbers of a row are a multiple of it

template <class T>
struct CodeTable {
  int64_t pixels, words;
  const T *codes;         // [pixels, 3]
  T low, per_unit;        // where the cube begins, on each axis, and cells per unit
  int64_t side;           // nodes of the cube along an axis
  const int32_t *places;  // [side, side, side]: row of each node; any number that is no row where it has none
  int64_t count, padded;
  const T *rows;  // [count, padded], padded >= words
  T *out;         // [words, pixels]
};

// Trilinear in the eight nodes around each code. Returns how many codes lack one of them, or are outside of
// the cube: their answers are NaN. Bits depend neither on the number of threads nor on the instruction set.
template <class T>
int64_t code_table(const CodeTable<T> &, int threads);

}  // namespace vlgs

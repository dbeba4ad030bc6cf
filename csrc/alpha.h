// The formula that both passes over the pixels share, so that they cannot drift apart.
#pragma once

#include "isa.h"
#include "simd.h"

namespace vlgs::VLGS_ISA_NS {

template <class T>
struct Offset {
  Pack<T> u, v;      // the pixel in the ellipse's own coordinates
  Pack<T> exponent;  // u^2 + v^2, never negative; weights fall off as 2^-exponent
};

template <class T>
VLGS_INLINE Offset<T> offset(const T *g, const Pack<T> &x, const Pack<T> &y) {
  const Pack<T> dx = x - splat(g[kMeanX]), dy = y - splat(g[kMeanY]);
  Offset<T> o;
  o.u = splat(g[kInvSigmaX]) * fnma(splat(g[kSlope]), dy, dx);
  o.v = splat(g[kInvSigmaY]) * dy;
  o.exponent = fma(o.u, o.u, o.v * o.v);
  return o;
}

// Pixel centres of block b of a tile.
template <class T>
struct Centres {
  Pack<T> x, y;
};
template <class T>
inline Centres<T> centres(const Grid &grid, int64_t tile, int b) {
  const T x0 = T(tile % grid.tiles_x * kTile + b % 4 * kBlock),
          y0 = T(tile / grid.tiles_x * kTile + b / 4 * kBlock);
  T x[kLanes], y[kLanes];
  for (int l = 0; l < kLanes; ++l) x[l] = x0 + T(l % 4) + T(0.5), y[l] = y0 + T(l / 4) + T(0.5);
  return {load(x), load(y)};
}

// Copies the records of a tile's list next to each other.
template <class T>
inline void gather_records(const Pass<T> &p, int64_t begin, int64_t end, T *to) {
  for (int64_t k = begin; k < end; ++k, to += kRecord) {
    store(to, load(p.records + int64_t(p.ranks[k]) * kRecord));
    to[kPlace] = T(k - begin);
  }
}

// Hands out pieces of one scratch array.
template <class T>
struct Carver {
  T *free;
  T *take(int64_t count) {
    T *piece = free;
    free += count;
    return piece;
  }
};

}  // namespace vlgs::VLGS_ISA_NS

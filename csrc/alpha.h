// The formula that both passes over the pixels share, so that they cannot drift apart.
#pragma once

#include <type_traits>

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

// A Gaussian over one block before any chain is looked at: nothing in it depends on what lies before or
// behind.
template <class T>
struct Footprint {
  Offset<T> o;
  Pack<T> falloff;
};
template <class T>
VLGS_INLINE Footprint<T> footprint(const T *g, const Pack<T> &x, const Pack<T> &y) {
  Footprint<T> f;
  f.o = offset(g, x, y);
  f.falloff = exp2_of_minus(f.o.exponent);
  return f;
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

// Four neighbouring pixels of three channels, from an image to lanes and back. With constant masks these are
// shuffles on every instruction set.
template <class T>
struct Quads {
  typedef T Quad __attribute__((vector_size(4 * sizeof(T))));
  using Place = std::conditional_t<sizeof(T) == 4, int32_t, int64_t>;
  typedef Place Places __attribute__((vector_size(4 * sizeof(T))));
};
template <class T>
inline void pixels_to_lanes(const T *pixels, T *lanes) {
  using Quad = typename Quads<T>::Quad;
  using Places = typename Quads<T>::Places;
  Quad a, b, c;  // r g b r, g b r g, b r g b
  std::memcpy(&a, pixels, sizeof a), std::memcpy(&b, pixels + 4, sizeof b),
      std::memcpy(&c, pixels + 8, sizeof c);
  const Quad red = __builtin_shuffle(__builtin_shuffle(a, b, Places{0, 3, 6, 0}), c, Places{0, 1, 2, 5});
  const Quad green = __builtin_shuffle(__builtin_shuffle(a, b, Places{1, 4, 7, 0}), c, Places{0, 1, 2, 6});
  const Quad blue = __builtin_shuffle(__builtin_shuffle(a, b, Places{2, 5, 0, 0}), c, Places{0, 1, 4, 7});
  std::memcpy(lanes, &red, sizeof red);
  std::memcpy(lanes + kLanes, &green, sizeof green);
  std::memcpy(lanes + 2 * kLanes, &blue, sizeof blue);
}
template <class T>
inline void lanes_to_pixels(const T *lanes, T *pixels) {
  using Quad = typename Quads<T>::Quad;
  using Places = typename Quads<T>::Places;
  Quad red, green, blue;
  std::memcpy(&red, lanes, sizeof red);
  std::memcpy(&green, lanes + kLanes, sizeof green);
  std::memcpy(&blue, lanes + 2 * kLanes, sizeof blue);
  const Quad a =
      __builtin_shuffle(__builtin_shuffle(red, green, Places{0, 4, 0, 1}), blue, Places{0, 1, 4, 3});
  const Quad b =
      __builtin_shuffle(__builtin_shuffle(green, blue, Places{1, 5, 0, 2}), red, Places{0, 1, 6, 3});
  const Quad c =
      __builtin_shuffle(__builtin_shuffle(red, green, Places{0, 3, 7, 0}), blue, Places{6, 1, 2, 7});
  std::memcpy(pixels, &a, sizeof a), std::memcpy(pixels + 4, &b, sizeof b),
      std::memcpy(pixels + 8, &c, sizeof c);
}

// Asks for the values of a Gaussian that a tile is about to need, unless they are so many that those asked
// for first would be gone when their turn comes.
template <class T>
[[gnu::always_inline]] inline void ask_for_values(const Pass<T> &p, int64_t row) {
  constexpr int64_t kMost = 256 / sizeof(T);
  for (int i = 0; i < p.num_parts; ++i)
    if (const int64_t channels = p.parts[i].channels; channels <= kMost)
      ask_for(p.parts[i].values + row * channels, channels);
}

// Copies the records of a tile's list next to each other.
template <class T>
inline void gather_records(const Pass<T> &p, int64_t begin, int64_t end, T *to) {
  for (int64_t k = begin; k < end; ++k, to += kRecord) {
    if (k + kGatherAhead < end) __builtin_prefetch(p.records + int64_t(p.ranks[k + kGatherAhead]) * kRecord);
    store(to, load(p.records + int64_t(p.ranks[k]) * kRecord));
    if (!p.narrow) ask_for_values(p, row_of(to));
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

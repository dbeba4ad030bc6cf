// Which Gaussian takes half of the light of each pixel.
#include "alpha.h"

namespace vlgs::VLGS_ISA_NS {

// The walk of the forward pass, front to back, with the same arithmetic and up to the last contribution that
// it noted for each pixel; a block is left once half of the light is gone in all of its pixels.
void median_rows(const Pass<T> &p, int64_t tile, int64_t *rows) {
  const int64_t begin = p.tile_begin[tile], length = p.tile_begin[tile + 1] - begin;
  const Pack<T> zero = splat(T(0)), half = splat(T(0.5));
  for (int b = 0; b < kBlocks; ++b) {
    const Centres<T> at = centres<T>(p.grid, tile, b);
    const Pack<T> last = load(p.last + (tile * p.chains * kBlocks + b) * kLanes);
    Pack<T> t = splat(T(1)), place = splat(T(-1));
    for (int64_t k = 0; k < length; ++k) {
      if (!((p.masks[begin + k] >> b) & 1)) continue;
      const Mask<T> going = (splat(T(k)) <= last) & (half < t);
      if (!any(going)) break;
      const T *g = p.records + int64_t(p.ranks[begin + k]) * kRecord;
      const Footprint<T> print = footprint(g, at.x, at.y);
      const Mask<T> reached = going & (print.o.exponent <= splat(g[kChains0 + kCutoff]));
      const Pack<T> alpha =
          select(reached, min(splat(g[kChains0 + kWeight]) * print.falloff, splat(p.alpha_max)), zero);
      t = fnma(alpha, t, t);
      place = select(reached & (t <= half), splat(T(k)), place);
    }
    T places[kLanes];
    store(places, place);
    const int64_t x0 = tile % p.grid.tiles_x * kTile + b % 4 * kBlock,
                  y0 = tile / p.grid.tiles_x * kTile + b / 4 * kBlock;
    for (int l = 0; l < kLanes; ++l) {
      const int64_t x = x0 + l % kBlock, y = y0 + l / kBlock;
      if (x >= p.grid.width || y >= p.grid.height) continue;
      rows[y * p.grid.width + x] = places[l] < 0 ? -1 : int64_t(p.ids[p.ranks[begin + int64_t(places[l])]]);
    }
  }
}

}  // namespace vlgs::VLGS_ISA_NS

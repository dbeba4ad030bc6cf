// Kept weights: how they are formed, and the two sparse products with them (cached_weights.h).
#include "alpha.h"

namespace vlgs::VLGS_ISA_NS {
namespace {

// First pixel of a block, counted over the tiles and then over the blocks of a tile.
struct Corner {
  int64_t x, y;
};
inline Corner corner(const Grid &grid, int64_t block) {
  const int64_t tile = block / kBlocks, b = block % kBlocks;
  return {tile % grid.tiles_x * kTile + b % 4 * kBlock, tile / grid.tiles_x * kTile + b / 4 * kBlock};
}

template <class T, int kWidth>
inline void add_channels(int64_t count, const uint32_t *ids, const T *weights, const T *values,
                         int64_t channels, T *sums) {
  Pack<T> acc[kWidth];
  for (auto &a : acc) a = splat(T(0));
  for (int64_t j = 0; j < count; ++j) {
    const Pack<T> weight = load(weights + j * kLanes);
    const T *value = values + int64_t(ids[j]) * channels;
    for (int k = 0; k < kWidth; ++k) acc[k] = fma(weight, splat(value[k]), acc[k]);
  }
  for (int k = 0; k < kWidth; ++k) store(sums + k * kLanes, acc[k]);
}

template <class T, int kWidth>
inline void gather_channels(int64_t count, const uint32_t *entries, const uint32_t *blocks, const T *weights,
                            const T *upstream, int64_t channels, T *d_value) {
  Pack<T> acc[kLanes];
  for (auto &a : acc) a = splat(T(0));
  for (int64_t j = 0; j < count; ++j) {
    const T *ahead =
        weights + int64_t(entries[j + kCachedWeightsAhead]) * kLanes;  // may be of the next Gaussian
    for (int i = 0; i < kLanes; i += 64 / int(sizeof(T))) __builtin_prefetch(ahead + i);
    const Pack<T> weight = load(weights + int64_t(entries[j]) * kLanes);
    const T *at = upstream + int64_t(blocks[j]) * channels * kLanes;
    for (int k = 0; k < kWidth; ++k) acc[k] = fma(weight, load(at + k * kLanes), acc[k]);
  }
  T sums[kLanes];
  sum_lanes(acc, sums);
  for (int k = 0; k < kWidth; ++k) d_value[k] = sums[k];
}

}  // namespace

// The walk of the forward pass, front to back, up to the last contribution that it noted for each pixel.
void cache_weights(const Pass<T> &p, int64_t tile, int64_t *counts, uint32_t *ids, T *weights) {
  const int64_t begin = p.tile_begin[tile], length = p.tile_begin[tile + 1] - begin;
  const Pack<T> zero = splat(T(0));
  for (int b = 0; b < kBlocks; ++b) {
    const Centres<T> at = centres<T>(p.grid, tile, b);
    const Pack<T> last = load(p.last + (tile * p.chains * kBlocks + b) * kLanes);
    Pack<T> t = splat(T(1));
    int64_t count = 0;
    for (int64_t k = 0; k < length && any(splat(T(k)) <= last); ++k) {
      if (!((p.masks[begin + k] >> b) & 1)) continue;
      const T *g = p.records + int64_t(p.ranks[begin + k]) * kRecord;
      const Offset<T> o = offset(g, at.x, at.y);
      const Mask<T> reached = (o.exponent <= splat(g[kChains0 + kCutoff])) & (splat(T(k)) <= last);
      if (!any(reached)) continue;
      if (ids) {
        const Pack<T> falloff = exp2_of_minus(o.exponent);
        const Pack<T> alpha = min(splat(g[kChains0 + kWeight]) * falloff, splat(p.alpha_max));
        store(weights, select(reached, alpha * t, zero));
        t = select(reached, fnma(alpha, t, t), t);
        weights += kLanes;
        *ids++ = p.ids[p.ranks[begin + k]];
      }
      ++count;
    }
    counts[b] = count;
  }
}

void cached_weights_render(const Grid &grid, int64_t block, int64_t count, const uint32_t *ids,
                           const T *weights, const T *values, int64_t channels, T *scratch, T *image) {
  int64_t k = 0;
  for (; k + 8 <= channels; k += 8)
    add_channels<T, 8>(count, ids, weights, values + k, channels, scratch + k * kLanes);
  for (; k + 3 <= channels; k += 3)
    add_channels<T, 3>(count, ids, weights, values + k, channels, scratch + k * kLanes);
  for (; k < channels; ++k)
    add_channels<T, 1>(count, ids, weights, values + k, channels, scratch + k * kLanes);
  const Corner first = corner(grid, block);
  for (int l = 0; l < kLanes; ++l) {
    const int64_t x = first.x + l % 4, y = first.y + l / 4;
    if (x >= grid.width || y >= grid.height) continue;
    for (int64_t c = 0; c < channels; ++c)
      image[(y * grid.width + x) * channels + c] = scratch[c * kLanes + l];
  }
}

void cached_weights_upstream(const Grid &grid, int64_t block, const T *d_image, int64_t channels,
                             int64_t count, T *packs) {
  const Corner first = corner(grid, block);
  for (int l = 0; l < kLanes; ++l) {
    const int64_t x = first.x + l % 4, y = first.y + l / 4;
    const bool inside = x < grid.width && y < grid.height;
    for (int64_t c = 0; c < count; ++c)
      packs[c * kLanes + l] = inside ? d_image[(y * grid.width + x) * channels + c] : T(0);
  }
}

void cached_weights_backward(int64_t count, const uint32_t *entries, const uint32_t *blocks, const T *weights,
                             const T *upstream, int64_t channels, T *d_value) {
  int64_t k = 0;
  for (; k + 8 <= channels; k += 8)
    gather_channels<T, 8>(count, entries, blocks, weights, upstream + k * kLanes, channels, d_value + k);
  for (; k + 3 <= channels; k += 3)
    gather_channels<T, 3>(count, entries, blocks, weights, upstream + k * kLanes, channels, d_value + k);
  for (; k < channels; ++k)
    gather_channels<T, 1>(count, entries, blocks, weights, upstream + k * kLanes, channels, d_value + k);
}

}  // namespace vlgs::VLGS_ISA_NS

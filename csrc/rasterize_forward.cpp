// Front-to-back compositing, one 4x4 block of pixels at a time: image = sum_i f_i a_i T_i, T_i = prod_{j<i}
// (1 - a_j).
#include "alpha.h"

namespace vlgs::VLGS_ISA_NS {
namespace {

template <class T>
struct Tile {
  const Pass<T> *pass;
  int64_t index, begin, count;  // its list is entries [begin, begin + count)
  const T *records;             // of its list
  uint32_t *list;               // places in its list that reach the block at hand
  T *weights;                   // [kMaxChains, kWeightsAhead, kLanes]
  T *sums;                      // [channels, kLanes]
};

template <class T, int kChains>
struct Rays {
  Pack<T> transmittance[kChains];  // negative once a pixel has stopped before its threshold
  Pack<T> last[kChains];
};

// The weights a_i T_i of one Gaussian in all chains; false once every pixel is done in every chain.
template <class T, int kChains, bool kBefore>
VLGS_INLINE bool weigh(const Pass<T> &p, const T *g, const Footprint<T> &print, Rays<T, kChains> &rays,
                       Pack<T> *weights) {
  const Pack<T> floor = splat(kBefore ? T(0) : p.transmittance_min);
  Mask<T> going[kChains];
  for (int c = 0; c < kChains; ++c) going[c] = floor < rays.transmittance[c];
  Mask<T> some_going = going[0];
  for (int c = 1; c < kChains; ++c) some_going = some_going | going[c];
  if (!any(some_going)) return false;

  const Pack<T> zero = splat(T(0));
  for (int c = 0; c < kChains; ++c) {
    const T *chain = g + kChains0 + 2 * c;
    Mask<T> reached = going[c] & (print.o.exponent <= splat(chain[kCutoff]));
    // An alpha of 0 leaves every bit of the transmittance.
    Pack<T> alpha = select(reached, min(splat(chain[kWeight]) * print.falloff, splat(p.alpha_max)), zero);
    Pack<T> &t = rays.transmittance[c];
    if constexpr (kBefore) {
      const Mask<T> crosses = reached & (fnma(alpha, t, t) <= splat(p.transmittance_min));
      reached = reached & ~crosses;
      alpha = select(crosses, zero, alpha);
      t = select(crosses, zero - t, t);
    }
    rays.last[c] = select(reached, splat(g[kPlace]), rays.last[c]);
    weights[c] = alpha * t;
    t = fnma(alpha, t, t);
  }
  return true;
}

template <class T, int kChains>
inline Rays<T, kChains> start_rays(const Pass<T> &p, const Centres<T> &at) {
  // Lanes beyond the image are done before they begin.
  const Mask<T> inside = (at.x <= splat(T(p.grid.width))) & (at.y <= splat(T(p.grid.height)));
  Rays<T, kChains> rays;
  for (int c = 0; c < kChains; ++c) {
    rays.transmittance[c] = select(inside, splat(T(1)), splat(T(0)));
    rays.last[c] = splat(T(-1));
  }
  return rays;
}

// Parts of three channels, all in registers; one per chain, or all on one chain.
template <class T, int kChains, int kParts, bool kBefore>
inline void sum_narrow(const Tile<T> &tile, const Centres<T> &at, int64_t reach, Rays<T, kChains> &rays) {
  Pack<T> sums[3 * kParts];
  for (auto &s : sums) s = splat(T(0));
  if (reach == 0) {
    for (int k = 0; k < 3 * kParts; ++k) store(tile.sums + k * kLanes, sums[k]);
    return;
  }
  tile.list[reach] = tile.list[0];  // a footprint is formed beyond the end, and thrown away
  const T *next = tile.records + int64_t(tile.list[0]) * kRecord;
  Footprint<T> next_print = footprint(next, at.x, at.y);
  for (int64_t j = 0; j < reach; ++j) {
    const T *g = next;
    const Footprint<T> print = next_print;
    next = tile.records + int64_t(tile.list[j + 1]) * kRecord;
    next_print = footprint(next, at.x, at.y);
    Pack<T> weights[kChains];
    if (!weigh<T, kChains, kBefore>(*tile.pass, g, print, rays, weights)) break;
    for (int k = 0; k < 3 * kParts; ++k)
      sums[k] = fma(weights[kChains == 1 ? 0 : k / 3], splat(g[kValues + k]), sums[k]);
  }
  for (int k = 0; k < 3 * kParts; ++k) store(tile.sums + k * kLanes, sums[k]);
}

template <class T, int kWidth>
inline void add_channels(const Tile<T> &tile, const Part<T> &part, int64_t channel, int64_t first,
                         int64_t count, T *sums) {
  Pack<T> acc[kWidth];
  for (int k = 0; k < kWidth; ++k) acc[k] = load(sums + k * kLanes);
  for (int64_t j = 0; j < count; ++j) {
    const T *g = tile.records + int64_t(tile.list[first + j]) * kRecord;
    const T *values = part.values + row_of(g) * part.channels + channel;
    const Pack<T> weight = load(tile.weights + (part.chain * kWeightsAhead + j) * kLanes);
    for (int k = 0; k < kWidth; ++k) acc[k] = fma(weight, splat(values[k]), acc[k]);
  }
  for (int k = 0; k < kWidth; ++k) store(sums + k * kLanes, acc[k]);
}

// As many sums as fit into registers beside what they are made of.
#if defined(__AVX512F__)
template <class T>
constexpr int kChunk = sizeof(T) == 4 ? 16 : 8;
#else
template <class T>
constexpr int kChunk = 8;
#endif

// Any number of channels: weights of a stretch of the list first, then the channels by chunks, and what is
// left by eight, four, two and one.
template <class T, int kChains, bool kBefore>
inline void sum_wide(const Tile<T> &tile, const Centres<T> &at, int64_t reach, Rays<T, kChains> &rays) {
  const Pass<T> &p = *tile.pass;
  for (int64_t i = 0; i < p.channels * kLanes; ++i) tile.sums[i] = 0;
  bool going = true;
  for (int64_t first = 0; first < reach && going; first += kWeightsAhead) {
    int64_t count = 0;
    for (; count < kWeightsAhead && first + count < reach; ++count) {
      const uint32_t place = tile.list[first + count];
      Pack<T> weights[kChains];
      const T *g = tile.records + int64_t(place) * kRecord;
      going = weigh<T, kChains, kBefore>(p, g, footprint(g, at.x, at.y), rays, weights);
      if (!going) break;
      for (int c = 0; c < kChains; ++c)
        store(tile.weights + (c * kWeightsAhead + count) * kLanes, weights[c]);
    }
    T *sums = tile.sums;
    for (int i = 0; i < p.num_parts; ++i) {
      const Part<T> &part = p.parts[i];
      int64_t k = 0;
      for (; k + kChunk<T> <= part.channels; k += kChunk<T>, sums += kChunk<T> * kLanes)
        add_channels<T, kChunk<T>>(tile, part, k, first, count, sums);
      if (kChunk<T> > 8 && part.channels & 8)
        add_channels<T, 8>(tile, part, k, first, count, sums), k += 8, sums += 8 * kLanes;
      if (part.channels & 4)
        add_channels<T, 4>(tile, part, k, first, count, sums), k += 4, sums += 4 * kLanes;
      if (part.channels & 2)
        add_channels<T, 2>(tile, part, k, first, count, sums), k += 2, sums += 2 * kLanes;
      if (part.channels & 1) add_channels<T, 1>(tile, part, k, first, count, sums), sums += kLanes;
    }
  }
}

template <class T>
void write_block(const Tile<T> &tile, int b, const T *transmittance) {
  const Pass<T> &p = *tile.pass;
  const int64_t x0 = tile.index % p.grid.tiles_x * kTile + b % 4 * kBlock;
  const int64_t y0 = tile.index / p.grid.tiles_x * kTile + b / 4 * kBlock;
  const int64_t columns = p.grid.width - x0 < kBlock ? p.grid.width - x0 : kBlock;
  for (int row = 0; row < kBlock && y0 + row < p.grid.height && columns > 0; ++row) {
    const int64_t pixel = (y0 + row) * p.grid.width + x0;
    const T *sums = tile.sums + row * kBlock;
    for (int i = 0; i < p.num_parts; ++i) {
      const int64_t channels = p.parts[i].channels;
      T *to = p.parts[i].image + pixel * channels;
      if (channels == 3 && columns == kBlock)
        lanes_to_pixels(sums, to);
      else
        for (int64_t x = 0; x < columns; ++x)
          for (int64_t k = 0; k < channels; ++k) to[x * channels + k] = sums[k * kLanes + x];
      sums += channels * kLanes;
    }
    for (int c = 0; c < p.chains; ++c)
      for (int64_t x = 0; x < columns; ++x)
        p.alphas[c][pixel + x] = 1 - transmittance[c * kLanes + row * kBlock + x];
  }
}

// Places of the masks that have bit b; writes up to kListSlack entries more than it returns.
inline int64_t list_block(const uint16_t *masks, int64_t count, int b, uint32_t *list) {
  int64_t reach = 0, k = 0;
#if defined(__AVX512F__)
  const __m256i bit = _mm256_set1_epi16(int16_t(1 << b));
  __m512i places = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  for (; k + 16 <= count; k += 16, places = _mm512_add_epi32(places, _mm512_set1_epi32(16))) {
    const __mmask16 has = _mm256_test_epi16_mask(_mm256_loadu_si256((const __m256i *)(masks + k)), bit);
    _mm512_storeu_si512(list + reach, _mm512_maskz_compress_epi32(has, places));
    reach += __builtin_popcount(has);
  }
#endif
  for (; k < count; ++k) {
    list[reach] = uint32_t(k);
    reach += (masks[k] >> b) & 1;
  }
  return reach;
}

template <class T, int kChains, bool kBefore>
void rasterize_tile(const Tile<T> &tile) {
  const Pass<T> &p = *tile.pass;
  for (int b = 0; b < kBlocks; ++b) {
    const int64_t reach = list_block(p.masks + tile.begin, tile.count, b, tile.list);
    const Centres<T> at = centres<T>(p.grid, tile.index, b);
    Rays<T, kChains> rays = start_rays<T, kChains>(p, at);
    if (p.narrow && p.num_parts == kChains)
      sum_narrow<T, kChains, kChains, kBefore>(tile, at, reach, rays);
    else if (p.narrow)
      sum_narrow<T, kChains, kNarrowParts, kBefore>(tile, at, reach, rays);
    else
      sum_wide<T, kChains, kBefore>(tile, at, reach, rays);

    T final[kChains * kLanes];
    const int64_t where = ((tile.index * kChains) * kBlocks + b) * kLanes;
    for (int c = 0; c < kChains; ++c) {
      Pack<T> t = rays.transmittance[c];
      if constexpr (kBefore) t = select(t <= splat(T(0)), splat(T(0)) - t, t);
      store(final + c * kLanes, t);
      if (!p.transmittance) continue;
      store(p.transmittance + where + c * kBlocks * kLanes, t);
      store(p.last + where + c * kBlocks * kLanes, rays.last[c]);
    }
    write_block(tile, b, final);
  }
}

}  // namespace

int64_t rasterize_forward_scratch(const Pass<T> &p, int64_t list_length) {
  return list_length * kRecord + kMaxChains * kWeightsAhead * kLanes + p.channels * kLanes;
}

void rasterize_forward(const Pass<T> &p, int64_t index, T *scratch, uint32_t *list) {
  const int64_t begin = p.tile_begin[index], count = p.tile_begin[index + 1] - begin;
  Carver<T> carver{scratch};
  T *records = carver.take(count * kRecord);
  gather_records(p, begin, begin + count, records);
  T *weights = carver.take(kMaxChains * kWeightsAhead * kLanes);
  const Tile<T> tile{&p, index, begin, count, records, list, weights, carver.take(p.channels * kLanes)};
  if (p.chains == 1)
    p.stop_before ? rasterize_tile<T, 1, true>(tile) : rasterize_tile<T, 1, false>(tile);
  else
    p.stop_before ? rasterize_tile<T, 2, true>(tile) : rasterize_tile<T, 2, false>(tile);
}

}  // namespace vlgs::VLGS_ISA_NS

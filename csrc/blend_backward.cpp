// The same walk back to front, one Gaussian of a tile at a time over the blocks it reaches, so that what
// belongs to the Gaussian is summed in registers and leaves them once per tile. README.md derives the
// recurrences.
#include "alpha.h"

namespace vlgs::VLGS_ISA_NS {
namespace {

constexpr int64_t kStride = kBlocks * kLanes;

template <class T>
struct Tile {
  const Pass<T> *pass;
  int64_t index, begin, count;
  const T *records;
  T *upstream;  // [kBlocks, padded channels + chains, kLanes]: gradients of the images, then of the alphas
  T *transmittance;  // [chains, kBlocks, kLanes] behind the Gaussian at hand
  const T *last;     // same shape
  T *behind;   // same shape: what lies behind, as seen from the Gaussian at hand, in the direction of the
               // gradient
  T *weights;  // same shape: a T of the Gaussian at hand
  T *centres;  // [2, kBlocks, kLanes]
  int64_t upstream_stride;
};

// Blocks whose last contribution lies at or behind a place, updated while the place moves forward.
struct Live {
  int order[kBlocks];
  int64_t last[kBlocks];
  int next = 0;
  uint32_t bits = 0;

  uint32_t at(int64_t place) {
    while (next < kBlocks && last[order[next]] >= place) bits |= 1u << order[next++];
    return bits;
  }
};

template <class T>
Live live_blocks(const Tile<T> &tile) {
  Live live;
  for (int b = 0; b < kBlocks; ++b) {
    live.last[b] = -1;
    for (int c = 0; c < tile.pass->chains; ++c)
      for (int l = 0; l < kLanes; ++l) {
        const T last = tile.last[c * kStride + b * kLanes + l];
        if (last > T(live.last[b])) live.last[b] = int64_t(last);
      }
    int i = b;
    for (; i > 0 && live.last[live.order[i - 1]] < live.last[b]; --i) live.order[i] = live.order[i - 1];
    live.order[i] = b;
  }
  return live;
}

// Pixels of one block to lanes: channels of an image [height, width, channels] become packs. Lanes beyond the
// image get 0.
template <class T>
inline void to_lanes(const Grid &grid, const T *image, int64_t channels, int64_t x0, int64_t y0, T *packs) {
  if (x0 >= grid.width || y0 >= grid.height) return;
  int64_t from[kLanes];
  bool inside = true;
  for (int l = 0; l < kLanes; ++l) {
    const int64_t x = x0 + l % 4, y = y0 + l / 4;
    inside &= (x < grid.width) & (y < grid.height);
    from[l] = (y * grid.width + x) * channels;
  }
  for (int64_t k = 0; k < channels; ++k)
    for (int l = 0; l < kLanes; ++l)
      if (inside || (x0 + l % 4 < grid.width && y0 + l / 4 < grid.height))
        packs[k * kLanes + l] = image[from[l] + k];
}

// Gradients of the images of a tile; false if any is not finite.
template <class T>
bool load_upstream(const Tile<T> &tile) {
  const Pass<T> &p = *tile.pass;
  const int64_t size = kBlocks * tile.upstream_stride;
  for (int64_t i = 0; i < size; ++i) tile.upstream[i] = 0;
  for (int b = 0; b < kBlocks; ++b) {
    const int64_t x0 = tile.index % p.grid.tiles_x * kTile + b % 4 * kBlock;
    const int64_t y0 = tile.index / p.grid.tiles_x * kTile + b / 4 * kBlock;
    T *to = tile.upstream + b * tile.upstream_stride;
    for (int i = 0; i < p.num_parts; to += p.parts[i++].padded * kLanes)
      if (p.parts[i].d_image) to_lanes(p.grid, p.parts[i].d_image, p.parts[i].channels, x0, y0, to);
    for (int c = 0; c < p.chains; ++c, to += kLanes)
      if (p.d_alphas[c]) to_lanes(p.grid, p.d_alphas[c], 1, x0, y0, to);
  }
  Mask<T> finite = ~Mask<T>{};
  for (int64_t i = 0; i < size; i += kLanes)
    finite = finite & (load(tile.upstream + i) * splat(T(0)) <= splat(T(0)));
  return !any(~finite);
}

// What one Gaussian collects over its blocks.
template <class T, int kChains>
struct Sums {
  Pack<T> moment[5], weight[kChains];
};

// Gradient by the weight and by the exponent in one block. toward[c] is the derivative of the loss by a T of
// chain c.
template <class T, int kChains>
VLGS_INLINE void step(const Tile<T> &tile, const T *g, int64_t place, int b, const Pack<T> *toward,
                      Sums<T, kChains> &sums, Pack<T> *weights) {
  const Pass<T> &p = *tile.pass;
  const Offset<T> o = offset(g, load(tile.centres + b * kLanes), load(tile.centres + kStride + b * kLanes));
  const Pack<T> falloff = exp2_of_minus(o.exponent), zero = splat(T(0)), one = splat(T(1));
  Pack<T> h = zero;
  for (int c = 0; c < kChains; ++c) {
    const T *chain = g + kChains0 + 2 * c;
    const int64_t at = c * kStride + b * kLanes;
    const Mask<T> reached = (o.exponent <= splat(chain[kCutoff])) & (splat(T(place)) <= load(tile.last + at));
    const Pack<T> raw = splat(chain[kWeight]) * falloff;
    const Pack<T> alpha = select(reached, min(raw, splat(p.alpha_max)), zero);
    Pack<T> t = load(tile.transmittance + at);
    t = select(reached, t * reciprocal(one - alpha), t);
    store(tile.transmittance + at, t);
    weights[c] = alpha * t;

    const Pack<T> behind = load(tile.behind + at), ahead = toward[c] - behind;
    store(tile.behind + at, fma(alpha, ahead, behind));
    const Mask<T> free = reached & (raw <= splat(p.alpha_max));  // the clamp passes no gradient
    const Pack<T> d_weight = select(free, t * ahead * falloff, zero);
    sums.weight[c] = sums.weight[c] + d_weight;
    if (p.shape_grad[c]) h = fma(splat(chain[kWeight]), d_weight, h);
  }
  const Pack<T> hu = h * o.u, hv = h * o.v;
  sums.moment[kMomentU] = sums.moment[kMomentU] + hu;
  sums.moment[kMomentV] = sums.moment[kMomentV] + hv;
  sums.moment[kMomentUU] = fma(hu, o.u, sums.moment[kMomentUU]);
  sums.moment[kMomentUV] = fma(hu, o.v, sums.moment[kMomentUV]);
  sums.moment[kMomentVV] = fma(hv, o.v, sums.moment[kMomentVV]);
}

// Three channels per chain: their gradients are summed in registers too.
template <class T, int kChains>
VLGS_INLINE void gaussian_narrow(const Tile<T> &tile, int64_t place, uint32_t blocks, T *slot) {
  const T *g = tile.records + place * kRecord;
  Pack<T> all[kLanes];
  for (auto &a : all) a = splat(T(0));
  Sums<T, kChains> sums{};
  Pack<T> d_values[3 * kChains];
  for (auto &d : d_values) d = splat(T(0));
  for (; blocks; blocks &= blocks - 1) {
    const int b = __builtin_ctz(blocks);
    const T *upstream = tile.upstream + b * tile.upstream_stride;
    Pack<T> toward[kChains], weights[kChains];
    for (int c = 0; c < kChains; ++c) {
      toward[c] = load(upstream + (4 * kChains + c) * kLanes);
      for (int k = 0; k < 3; ++k)
        toward[c] = fma(splat(g[kValues + 3 * c + k]), load(upstream + (4 * c + k) * kLanes), toward[c]);
    }
    step<T, kChains>(tile, g, place, b, toward, sums, weights);
    for (int c = 0; c < kChains; ++c)
      for (int k = 0; k < 3; ++k)
        d_values[3 * c + k] = fma(weights[c], load(upstream + (4 * c + k) * kLanes), d_values[3 * c + k]);
  }
  for (int i = 0; i < 5; ++i) all[i] = sums.moment[i];
  for (int c = 0; c < kChains; ++c) all[kSlotWeight0 + c] = sums.weight[c];
  for (int c = 0; c < 3 * kChains; ++c) all[kSlotValues + c] = d_values[c];
  sum_lanes(all, slot);
}

template <class T>
VLGS_INLINE Pack<T> project_values(const T *values, const T *upstream, int64_t channels, Pack<T> start) {
  Pack<T> acc[4] = {start, splat(T(0)), splat(T(0)), splat(T(0))};
  int64_t k = 0;
  for (; k + 4 <= channels; k += 4)
    for (int i = 0; i < 4; ++i) acc[i] = fma(splat(values[k + i]), load(upstream + (k + i) * kLanes), acc[i]);
  for (; k < channels; ++k) acc[0] = fma(splat(values[k]), load(upstream + k * kLanes), acc[0]);
  return (acc[0] + acc[2]) + (acc[1] + acc[3]);
}

// Gradients of kWidth channels (a multiple of 4, at most 16), summed over the blocks.
template <class T, int kWidth>
VLGS_INLINE void value_gradients(const Tile<T> &tile, int chain, uint32_t blocks, int64_t offset, T *slot) {
  Pack<T> acc[kLanes];
  for (auto &a : acc) a = splat(T(0));
  for (; blocks; blocks &= blocks - 1) {
    const int b = __builtin_ctz(blocks);
    const Pack<T> weight = load(tile.weights + chain * kStride + b * kLanes);
    const T *upstream = tile.upstream + b * tile.upstream_stride + offset * kLanes;
    for (int k = 0; k < kWidth; ++k) acc[k] = fma(weight, load(upstream + k * kLanes), acc[k]);
  }
  T sums[kLanes];
  sum_lanes(acc, sums);
  for (int k = 0; k < kWidth; ++k) slot[k] = sums[k];
}

template <class T, int kChains>
inline void gaussian_wide(const Tile<T> &tile, int64_t place, uint32_t blocks, T *slot) {
  const Pass<T> &p = *tile.pass;
  const T *g = tile.records + place * kRecord;
  const int64_t id = p.ids[p.ranks[tile.begin + place]];
  Sums<T, kChains> sums{};
  for (uint32_t rest = blocks; rest; rest &= rest - 1) {
    const int b = __builtin_ctz(rest);
    const T *upstream = tile.upstream + b * tile.upstream_stride;
    Pack<T> toward[kChains], weights[kChains];
    for (int c = 0; c < kChains; ++c) toward[c] = load(upstream + (p.padded_channels + c) * kLanes);
    for (int i = 0; i < p.num_parts; ++i) {
      const Part<T> &part = p.parts[i];
      toward[part.chain] =
          project_values(part.values + id * part.channels, upstream, part.channels, toward[part.chain]);
      upstream += part.padded * kLanes;
    }
    step<T, kChains>(tile, g, place, b, toward, sums, weights);
    for (int c = 0; c < kChains; ++c) store(tile.weights + c * kStride + b * kLanes, weights[c]);
  }
  Pack<T> all[kLanes];
  for (auto &a : all) a = splat(T(0));
  for (int i = 0; i < 5; ++i) all[i] = sums.moment[i];
  for (int c = 0; c < kChains; ++c) all[kSlotWeight0 + c] = sums.weight[c];
  T head[kLanes];
  sum_lanes(all, head);
  for (int i = 0; i < kSlotHead; ++i) slot[i] = head[i];

  int64_t offset = 0;
  for (int i = 0; i < p.num_parts; ++i) {
    const Part<T> &part = p.parts[i];
    T *to = slot + part.slot;
    int64_t k = 0;
    for (; k + 16 <= part.padded; k += 16)
      value_gradients<T, 16>(tile, part.chain, blocks, offset + k, to + k);
    if (part.padded - k == 12) value_gradients<T, 12>(tile, part.chain, blocks, offset + k, to + k);
    if (part.padded - k == 8) value_gradients<T, 8>(tile, part.chain, blocks, offset + k, to + k);
    if (part.padded - k == 4) value_gradients<T, 4>(tile, part.chain, blocks, offset + k, to + k);
    offset += part.padded;
  }
}

template <class T, int kChains>
void blend_tile_backward(const Tile<T> &tile, T *slots) {
  const Pass<T> &p = *tile.pass;
  Live live = live_blocks(tile);
  for (int64_t place = tile.count - 1; place >= 0; --place) {
    const uint32_t blocks = p.masks[tile.begin + place] & live.at(place);
    T *slot = slots + place * p.slot_size;
    if (!blocks)
      for (int64_t i = 0; i < p.slot_size; ++i) slot[i] = 0;
    else if (p.narrow)
      gaussian_narrow<T, kChains>(tile, place, blocks, slot);
    else
      gaussian_wide<T, kChains>(tile, place, blocks, slot);
  }
}

}  // namespace

template <class T>
int64_t backward_scratch(const Pass<T> &p, int64_t list_length) {
  return list_length * kRecord + (p.padded_channels + p.chains) * kStride + (3 * p.chains + 2) * kStride;
}

template <class T>
bool blend_backward(const Pass<T> &p, int64_t index, T *scratch, T *slots) {
  const int64_t begin = p.tile_begin[index], count = p.tile_begin[index + 1] - begin,
                state = p.chains * kStride;
  Carver<T> carver{scratch};
  Tile<T> tile{};
  tile.pass = &p;
  tile.index = index, tile.begin = begin, tile.count = count;
  T *records = carver.take(count * kRecord);
  tile.records = records;
  tile.upstream_stride = (p.padded_channels + p.chains) * kLanes;
  tile.upstream = carver.take(kBlocks * tile.upstream_stride);
  tile.transmittance = carver.take(state);
  tile.behind = carver.take(state);
  tile.weights = carver.take(state);
  tile.centres = carver.take(2 * kStride);
  tile.last = p.last + index * state;
  if (!load_upstream(tile)) return false;
  gather_records(p, begin, begin + count, records);
  for (int64_t i = 0; i < state; ++i)
    tile.transmittance[i] = p.transmittance[index * state + i], tile.behind[i] = 0;
  for (int b = 0; b < kBlocks; ++b) {
    const Centres<T> at = centres<T>(p.grid, index, b);
    store(tile.centres + b * kLanes, at.x);
    store(tile.centres + kStride + b * kLanes, at.y);
  }
  p.chains == 1 ? blend_tile_backward<T, 1>(tile, slots) : blend_tile_backward<T, 2>(tile, slots);
  return true;
}

template int64_t backward_scratch(const Pass<float> &, int64_t);
template int64_t backward_scratch(const Pass<double> &, int64_t);
template bool blend_backward(const Pass<float> &, int64_t, float *, float *);
template bool blend_backward(const Pass<double> &, int64_t, double *, double *);

}  // namespace vlgs::VLGS_ISA_NS
